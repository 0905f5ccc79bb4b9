"""The stage `views`: what past images and wrist cameras add to the paper's form."""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Amounts, Bar
from dextouch.episodes import EpisodeStore
from dextouch.geometry import transform
from dextouch.hands.actions import HandTrajectory, actions_from_poses
from dextouch.schemas import Observation, RolloutStart
from dextouch.streams import HEAD_CAMERA
from services.evaluation.statistics import bootstrap_mean_interval
from services.twin.episodes import GridLog, record, write_episode
from services.twin.settings import TwinSettings
from services.twin.simulation import MODEL_RATE_HZ
from services.twin.stage import Stage, command_row
from services.twin.take_options import MIXES, options_of
from services.world_model import checkpoints
from services.world_model.joint_world import JointWorld
from services.world_model.network.configuration import FRAMES_PER_LATENT, NetworkConfig
from services.world_model.network.model import JointWorldModel
from services.world_model.paper_settings import TrainSettings
from services.world_model.training import joint_dataset
from services.world_model.training.evaluation import predict_all
from services.world_model.training.joint_trainer import TrainingRun

WRISTS: Final = ("camera_wrist_left", "camera_wrist_right")
_AMOUNTS: Final = Amounts(
    usual={"scenes": 160, "takes": 60, "heldout": 24, "seeds": 3, "cpu_s": 60.0},
    quick={"scenes": 6, "takes": 2, "heldout": 2, "seeds": 1, "cpu_s": 1.0},
)
_SCENE_TASKS: Final = ("stack_bowls", "place_shoes")
_TOUCH_TASKS: Final = ("insert_peg", "stand_bottle")
# The head looks at the scene, away for a chunk, back, and away again.
_CHUNK, _NUM_STEPS = 16, 49
_AWAY_RAD: Final = (0.9, 1.2)
_HELDOUT_SEED: Final = 50_000
_PARTS: Final = ("whole chunk", "last four images")


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this stage."""
    _AMOUNTS.add_options(
        parser,
        scenes="scenes that the head looks away from, for training",
        takes="takes a task with wrist cameras, for training",
        heldout="held-out scenes, or takes a task",
        seeds="training seeds",
        cpu_s="CPU seconds of each training",
    )


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Train with and without each, and compare errors of held-out scenes."""
    amounts = _AMOUNTS.of(options)
    train = partial(_trained, folder=folder, cpu_s=amounts["cpu_s"])
    small = NetworkConfig(image_px=16, patch_px=4, use_touch=False, use_scene_encoder=False)
    results: dict[str, list[list[float]]] = {}
    with bar("views", 4 * amounts["seeds"] + 2) as step:
        step("scenes")
        scenes = _scenes(range(amounts["scenes"]))
        unseen = _scenes(range(_HELDOUT_SEED, _HELDOUT_SEED + amounts["heldout"]))
        past = small.model_copy(update={"past_images": 1, "past_stride": 8})
        for seed in range(amounts["seeds"]):
            for name, config in (("without past images", small), ("with one past image", past)):
                step(f"{name}, seed {seed}")
                world = JointWorld(train(scenes, config, seed))
                found = [_looked_back(world, scene) for scene in unseen]
                for part, errors in zip(_PARTS, zip(*found, strict=True), strict=True):
                    results.setdefault(f"{name}, {part}", []).append(list(errors))
        step("takes")
        takes = _takes(range(amounts["takes"]), folder / "takes")
        heldout = _takes(range(_HELDOUT_SEED, _HELDOUT_SEED + amounts["heldout"]), folder / "held")
        wrists = NetworkConfig(further_views=WRISTS)
        for seed in range(amounts["seeds"]):
            for name, config in (("head camera", NetworkConfig()), ("and wrist cameras", wrists)):
                step(f"{name}, seed {seed}")
                seen = takes if config.further_views else [_head_alone(one) for one in takes]
                held = heldout if config.further_views else [_head_alone(one) for one in heldout]
                model = train(seen, config, seed).model
                results.setdefault(name, []).append([_touch_error(model, one) for one in held])
    return _report(results, amounts)


def _report(results: dict[str, list[list[float]]], amounts: dict[str, Any]) -> StageReport:
    each = {name: np.array(rows) for name, rows in results.items()}
    pairs = [(f"without past images, {part}", f"with one past image, {part}") for part in _PARTS]
    titles = [f"images when the head comes back, {part}, MSE (of 255²)" for part in _PARTS]
    what = dict(zip(titles, pairs, strict=True))
    what["touch of held-out takes, MSE (kPa²)"] = "head camera", "and wrist cameras"
    tables = []
    for title, (base, other) in what.items():
        change = (each[other] - each[base]).mean(axis=0)
        found = bootstrap_mean_interval(change, np.random.default_rng(0))
        rows = [
            (name, *(f"{one:.4g}" for one in each[name].mean(axis=1)), f"{each[name].mean():.4g}")
            for name in (base, other)
        ]
        mean = f"{change.mean():.4g} [{found.low:.4g}, {found.high:.4g}]"
        rows.append(("difference", *_differences(each, base, other), mean))
        seeds = (f"seed {seed}" for seed in range(amounts["seeds"]))
        tables.append(ResultTable(title, ("", *seeds, "mean [95 %]"), rows))
    return StageReport(
        stage="views",
        packages=("numpy", "torch", "mujoco-core"),
        options=amounts,
        tables=tables,
        requirements=[],
        data={name: rows.tolist() for name, rows in each.items()},
    )


def _differences(each: dict[str, np.ndarray], base: str, other: str) -> Sequence[str]:
    return [f"{one:.4g}" for one in (each[other] - each[base]).mean(axis=1)]


def _trained(
    episodes: Sequence[joint_dataset.EpisodeArrays],
    config: NetworkConfig,
    seed: int,
    *,
    folder: Path,
    cpu_s: float,
) -> checkpoints.Checkpoint:
    """A model trained on the episodes, through a file."""
    output = folder / "model.safetensors"
    settings = TrainSettings(
        episodes="", output=output, seed=seed, cpu_budget_s=cpu_s, network=config
    )
    run = TrainingRun(episodes, settings)
    run.fit_codecs()
    run.run()
    model = run.whole_average()
    if model is None:
        raise AssertionError("one process has the whole model")
    metadata = checkpoints.CheckpointMetadata(
        name="views",
        network=config,
        tasks=tuple(sorted({episode.task for episode in episodes})),
        command="",
        seed=seed,
        training_steps=run.budget.step,
        training_cpu_s=run.budget.cpu_s,
        train_episode_ids=(),
        train_fingerprints=(),
        data_hash="",
        view_dropout=settings.windows.view_dropout,
    )
    checkpoints.write_checkpoint(output, model, metadata)
    return checkpoints.read_checkpoint(output)


def _scenes(seeds: range) -> list[joint_dataset.EpisodeArrays]:
    """Scenes of the twin with still hands, from which the head looks away and back."""
    stages = [
        Stage(task, "robot", TwinSettings(image_height_px=16, image_width_px=16))
        for task in _SCENE_TASKS
    ]
    return [_scene(stages[seed % len(stages)], seed) for seed in seeds]


def _scene(stage: Stage, seed: int) -> joint_dataset.EpisodeArrays:
    stage.dress(seed, varied=True)
    plan = stage.plan(seed, varied=True)
    anchor = stage.start(plan)
    draw = np.random.default_rng([seed, 7])
    turn_rad = draw.choice([-1, 1]) * draw.uniform(*_AWAY_RAD)
    share = np.sin(np.pi * np.arange(_NUM_STEPS) / (2 * _CHUNK)) ** 2
    heads = anchor.T_world_camera_head @ np.stack([_yaw(turn_rad * one) for one in share])
    commands = replace(_repeated(plan.commands, _NUM_STEPS), Ts_world_camera_head=heads)
    simulation, grid = stage.simulation, GridLog(stage)
    images, touch = [], []
    for row in range(_NUM_STEPS):
        for _ in simulation.advance(command_row(commands, row)) if row else ():
            pass
        grid.sample()
        images.append(stage.rig.image(simulation, HEAD_CAMERA))
        touch.append(simulation.tactile_kpa)
    return joint_dataset.EpisodeArrays(
        episode_id=f"{stage.task.name}-{seed}",
        task=stage.task.name,
        instruction=stage.task.instruction,
        scene=f"{stage.task.name}/{seed}",
        images=np.stack(images),
        tactile_kpa=np.stack(touch).astype(np.float32),
        tactile_valid=np.ones((_NUM_STEPS, 2), dtype=np.bool_),
        actions={
            "measured": actions_from_poses(grid.trajectory(), anchor),
            "commanded": actions_from_poses(commands, anchor),
        },
        anchor=anchor,
        K_head=stage.rig.K[HEAD_CAMERA],
        model_rate_hz=float(MODEL_RATE_HZ),
        content_sha256=f"{seed:064x}",
    )


def _repeated(commands: HandTrajectory, num_steps: int) -> HandTrajectory:
    """The first command, again and again."""
    return HandTrajectory(*(one[:1].repeat(num_steps, axis=0) for one in vars(commands).values()))


def _yaw(angle_rad: float) -> Float64[np.ndarray, "4 4"]:
    """A turn about the y axis of a camera's optical frame, which points down."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return transform(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), np.zeros(3))


def _looked_back(world: JointWorld, scene: joint_dataset.EpisodeArrays) -> tuple[float, float]:
    """Errors of the images of a rollout's second chunk, in which the head comes back.

    Of all its images, and of the last four, when the head is back.
    """
    actions = scene.actions["commanded"]
    seen = Observation(
        first_step=0,
        images={HEAD_CAMERA: scene.images[:1]},
        tactile_kpa=scene.tactile_kpa[:1],
        action_reached=scene.actions["measured"][:1],
        reached_is_measured=True,
    )
    start = RolloutStart(
        scene.task, 0, scene.instruction, "commanded", seen, scene.anchor, scene.K_head
    )
    state = world.reset(start).state
    state = world.step(state, actions[1 : _CHUNK + 1], seed=0).state
    back = slice(_CHUNK + 1, 2 * _CHUNK + 1)
    shown = world.step(state, actions[back], seed=1).observation.images[HEAD_CAMERA]
    square = np.square(shown.astype(np.float64) - scene.images[back])
    return float(square.mean()), float(square[-FRAMES_PER_LATENT:].mean())


def _takes(seeds: range, folder: Path) -> list[joint_dataset.EpisodeArrays]:
    """Takes with noise, from a store that has the wrist cameras, too."""
    store = EpisodeStore(folder)
    for task in _TOUCH_TASKS:
        stage = Stage(task, "robot", TwinSettings())
        for seed in seeds:
            options = options_of(task, seed, MIXES["ladder"])
            options = replace(options, image_every=1, streams="training")
            write_episode(store, record(stage, seed, options))
    return joint_dataset.load_episodes(str(folder), further_views=WRISTS)


def _head_alone(take: joint_dataset.EpisodeArrays) -> joint_dataset.EpisodeArrays:
    return replace(take, further=())


def _touch_error(model: JointWorldModel, take: joint_dataset.EpisodeArrays) -> float:
    """Error of the touch of all windows of a take that begin at every eighth step."""
    starts = range(0, len(take) - _CHUNK, 8)
    windows = [
        take.cut(joint_dataset.WindowPosition(0, start, _CHUNK + 1, "commanded"))
        for start in starts
    ]
    found = predict_all(model, [window.request for window in windows]).tactile_kpa
    true = np.stack([window.tactile_kpa[1:] for window in windows])
    return float(np.square(found - true).mean())
