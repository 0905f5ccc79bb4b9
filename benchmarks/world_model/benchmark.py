"""The benchmark stage `world-model`: imagined rollouts of the twin's held-out demonstrations."""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from benchmarks.chart import Panel, Point
from benchmarks.evaluator.playing import start_in_twin
from benchmarks.figures import Figure, Requirement, at_least, at_most, every_round, interleaved
from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Amounts, Bar
from benchmarks.world_model.coarse import with_coarse_products
from dextouch.errors import InvalidInputError
from dextouch.metrics.tactile import contact_f1
from dextouch.schemas import CHUNK_STEPS, EVERYTHING, Observation, ReturnSelector, RolloutStart
from dextouch.streams import HEAD_CAMERA
from dextouch.worlds import BatchWorld, CopyFirstWorld, World
from services.twin.settings import TwinSettings
from services.twin.stage import script_name, scripted_actions
from services.twin.tasks import TASK_NAMES
from services.twin.world import TwinWorld
from services.world_model.checkpoints import read_checkpoint, read_state_checkpoint
from services.world_model.joint_world import JointWorld
from services.world_model.network.configuration import Precision, Sampler
from services.world_model.network.model import Sampling
from services.world_model.shipped_checkpoints import PRETRAINED, STATE_MODEL, paper_form_checkpoint
from services.world_model.state_world import StateWorld


@dataclass(frozen=True)
class HeldOut:
    """One demonstration: its start, its commanded actions, and the true images and touch.

    Row i of `actions`, `images` and `tactile_kpa` belongs to step i + 1.
    """

    start: RolloutStart
    actions: Float64[np.ndarray, "steps 67"]
    images: UInt8[np.ndarray, "steps h w 3"]
    tactile_kpa: Float32[np.ndarray, "steps 2 320"]

    @property
    def chunks(self) -> list[Float64[np.ndarray, "16 67"]]:
        """The actions in chunks of 16 steps; a shorter remainder is dropped."""
        whole = len(self.actions) // CHUNK_STEPS
        return [self.actions[CHUNK_STEPS * k :][:CHUNK_STEPS] for k in range(whole)]


def held_out(tasks: Sequence[str], seeds: Sequence[int], image_px: int) -> list[HeldOut]:
    """The twin's demonstrations of tasks and seeds, seen by the head camera in square images."""
    settings = TwinSettings(
        cameras=(HEAD_CAMERA,), image_height_px=image_px, image_width_px=image_px
    )
    world = TwinWorld(settings)
    return [_played(world, task, seed) for task in tasks for seed in seeds]


def _played(world: TwinWorld, task: str, seed: int) -> HeldOut:
    stage = world.stage(task)
    begun, start, _ = start_in_twin(world, task, seed, stage.task.instruction)
    actions = scripted_actions(stage, seed, script_name(0.0))
    state, seen = begun.state, []
    for first in range(0, len(actions), CHUNK_STEPS):
        stepped = world.step(state, actions[first : first + CHUNK_STEPS], seed=0)
        state = stepped.state
        seen.append(stepped.observation)
    images = np.concatenate([one.images[HEAD_CAMERA] for one in seen])
    return HeldOut(start, actions, images, np.concatenate([one.tactile_kpa for one in seen]))


@dataclass(frozen=True)
class Imagined:
    """All rollouts of one world: the observation of each chunk, and milliseconds per chunk."""

    seen: list[list[Observation]]
    ms: float


@dataclass(frozen=True)
class RolloutError:
    """Errors of whole rollouts relative to the twin: RMS errors, and F1 of taxel contact."""

    image_levels: float
    touch_kpa: float
    contact_f1: float


def imagine(
    world: World[Any], episodes: Sequence[HeldOut], selector: ReturnSelector = EVERYTHING
) -> Imagined:
    """Play every episode's actions, each chunk from the predicted end of the previous one."""
    states = [world.reset(episode.start).state for episode in episodes]
    seen: list[list[Observation]] = [[] for _ in episodes]
    num_chunks = 0
    begin_s = time.process_time()
    for index, episode in enumerate(episodes):
        for chunk, actions in enumerate(episode.chunks):
            stepped = world.step(states[index], actions, seed=chunk, selector=selector)
            states[index] = stepped.state
            seen[index].append(stepped.observation)
            num_chunks += 1
    elapsed_s = time.process_time() - begin_s
    return Imagined(seen, 1e3 * elapsed_s / num_chunks)


def imagine_together(
    world: BatchWorld[Any], episodes: Sequence[HeldOut], num_rollouts: int, selector: ReturnSelector
) -> Imagined:
    """Several rollouts in one batch, of the episodes in turn; milliseconds per rollout's chunk."""
    played = [episodes[index % len(episodes)] for index in range(num_rollouts)]
    states = [world.reset(episode.start).state for episode in played]
    num_chunks = min(len(episode.chunks) for episode in played)
    begin_s = time.process_time()
    for chunk in range(num_chunks):
        stepped = world.step_batch(
            states,
            np.stack([episode.chunks[chunk] for episode in played]),
            seeds=range(num_rollouts),
            selectors=[selector] * num_rollouts,
        )
        states = [one.state for one in stepped]
    elapsed_s = time.process_time() - begin_s
    return Imagined([], 1e3 * elapsed_s / (num_rollouts * num_chunks))


def rollout_error(imagined: Imagined, episodes: Sequence[HeldOut]) -> RolloutError:
    """Errors of rollouts with all images relative to the twin."""
    all_seen = [one for seen in imagined.seen for one in seen]
    pairs = zip(imagined.seen, episodes, strict=True)
    lengths = [(episode, CHUNK_STEPS * len(seen)) for seen, episode in pairs]
    images = np.concatenate([one.images[HEAD_CAMERA] for one in all_seen])
    true_images = np.concatenate([episode.images[:length] for episode, length in lengths])
    off_levels = images.astype(np.float64) - true_images
    touch = np.concatenate([one.tactile_kpa for one in all_seen])
    true_touch = np.concatenate([episode.tactile_kpa[:length] for episode, length in lengths])
    off_kpa = touch.astype(np.float64) - true_touch
    return RolloutError(
        image_levels=float(np.sqrt(np.mean(off_levels**2))),
        touch_kpa=float(np.sqrt(np.mean(off_kpa**2))),
        contact_f1=contact_f1(predicted_kpa=touch, true_kpa=true_touch),
    )


COPY_FIRST: Final = "copy-first"
MAX_CHUNK_MS: Final = 50.0
# Requirements on the state model as served: one rollout, and sixteen in a batch.
MAX_STATE_CHUNK_MS: Final = {"no image": 7.0, "the last image": 14.0, "all images": 45.0}
MIN_BATCH_SPEEDUP: Final = 2.0
STATE_BATCHES: Final = (1, 4, 16)
IMAGES_PER_CHUNK: Final = {"no image": 0, "the last image": 1, "all images": CHUNK_STEPS}


@dataclass(frozen=True)
class Variant:
    """A sampling setting; `recomputed`: nothing is shared by its steps."""

    steps: int
    sampler: Sampler = "euler"
    precision: Precision = "float32"
    recomputed: bool = False

    @property
    def name(self) -> str:
        """Name in tables and charts."""
        solver = "UniPC" if self.sampler == "unipc" else "Euler"
        steps = f"{self.steps} {solver} step{'s' if self.steps > 1 else ''}"
        return f"{steps}, {self.precision}{', context recomputed' * self.recomputed}"


def error_table(
    times_ms: Mapping[str, Figure],
    errors: Mapping[str, RolloutError],
    served: str,
    num_episodes: int,
) -> ResultTable:
    """Time of a chunk of 16 steps and errors of whole rollouts."""
    return ResultTable(
        f"{num_episodes} held-out rollouts, chained, all images; RMS errors over all steps",
        ("world", "ms a chunk", "image (of 255)", "touch (kPa)", "contact F1"),
        [
            (
                name + (" (as served)" if name == served else ""),
                times_ms[name].text(),
                f"{error.image_levels:.2f}",
                f"{error.touch_kpa:.2f}",
                f"{error.contact_f1:.2f}",
            )
            for name, error in errors.items()
        ],
    )


def cost_name(amount: str, batch: int) -> str:
    """Name of the figure for requested images and a batch size."""
    return f"{amount}, batch of {batch}"


def state_model_table(costs_ms: Mapping[str, Figure], name: str) -> ResultTable:
    """Time and image rate of the state model by requested images and batch size."""
    rows = []
    for batch in STATE_BATCHES:
        for amount, num_images in IMAGES_PER_CHUNK.items():
            figure = costs_ms[cost_name(amount, batch)]
            rate = f"{1e3 * num_images / figure.median:.0f}" if num_images else ""
            rows.append((amount, str(batch), figure.text(), rate))
    return ResultTable(
        f"State model {name}: a chunk of one rollout, by requested images and batch size",
        ("requested", "batch", "ms a chunk", "images a second"),
        rows,
    )


def state_model_requirements(costs_ms: Mapping[str, Figure]) -> list[Requirement]:
    """Requirements on single rollouts, and on batches compared with them."""
    chunks = [
        at_most(
            f"state model, a chunk, {amount}", costs_ms[cost_name(amount, 1)].median, bound_ms, "ms"
        )
        for amount, bound_ms in MAX_STATE_CHUNK_MS.items()
    ]
    single, batch = (costs_ms[cost_name("all images", count)] for count in (1, 16))
    speedup = single.over(batch).median
    what = "state model, all images, throughput of a batch of 16 over single rollouts"
    return [*chunks, at_least(what, speedup, MIN_BATCH_SPEEDUP)]


def panels(
    times_ms: Mapping[str, Figure], errors: Mapping[str, RolloutError], served: str
) -> list[Panel]:
    """Time of a chunk against image error and against touch error."""
    kinds = (
        ("Imagined images", "RMS error (levels of 255)", "image_levels"),
        ("Imagined touch", "RMS error (kPa)", "touch_kpa"),
    )
    return [
        Panel(
            title,
            "processor ms a chunk",
            label,
            [
                Point.of(name, times_ms[name], getattr(error, key), is_ours=name == served)
                for name, error in errors.items()
            ],
        )
        for title, label, key in kinds
    ]


def requirements(
    times_ms: Mapping[str, Figure],
    errors: Mapping[str, RolloutError],
    served: str,
) -> list[Requirement]:
    """Requirements on speed, and on errors relative to repeating the first step."""
    ours, copied = errors[served], errors[COPY_FIRST]
    image, touch = ours.image_levels / copied.image_levels, ours.touch_kpa / copied.touch_kpa
    return [
        at_most("a chunk, all images", times_ms[served].median, MAX_CHUNK_MS, "ms"),
        at_most("image error, share of copy-first's", image, 1.0),
        at_most("touch error, share of copy-first's", touch, 1.0),
    ]


# Of demonstrations that nothing is trained on.
FIRST_SEED: Final = 30_000
AMOUNTS: Final = Amounts(usual={"rounds": 7, "seeds": 6}, quick={"rounds": 1, "seeds": 1})
VARIANTS: Final = (
    *(Variant(steps) for steps in (1, 2, 4, 8)),
    *(Variant(steps, recomputed=True) for steps in (2, 4, 8)),
    *(Variant(steps, "unipc") for steps in (2, 4, 8)),
    *(Variant(steps, precision="bfloat16") for steps in (1, 2, 4)),
)
SELECTORS: Final = {
    "all images": EVERYTHING,
    "the last image": ReturnSelector(steps="last"),
    "no image": ReturnSelector(cameras=()),
}
TOGETHER: Final = (1, 4, 8)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    parser.add_argument(
        "--checkpoint", type=Path, help="model in the paper's form (default: the package's own)"
    )
    parser.add_argument(
        "--state-model", type=Path, help="state model to time (default: the package's own)"
    )
    AMOUNTS.add_options(parser, rounds="rounds", seeds="episodes per task")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Predict held-out demonstrations with different settings, alternately."""
    plan = AMOUNTS.of(options)
    checkpoint = read_checkpoint(options.checkpoint or paper_form_checkpoint())
    network = checkpoint.metadata.network
    variants = {
        one.name: JointWorld(
            checkpoint if one.precision == "float32" else with_coarse_products(checkpoint),
            sampling=Sampling(one.steps, one.sampler, keep_context=not one.recomputed),
        )
        for one in VARIANTS
    }
    served = Variant(network.sampling_steps, network.sampler).name
    world = variants.setdefault(served, JointWorld(checkpoint))
    tasks = [task for task in TASK_NAMES if task in world.description.tasks]
    if not tasks:
        raise InvalidInputError(
            f"bench world-model: the model supports {world.description.tasks}, expected at least "
            f"one task of the twin: {TASK_NAMES}"
        )
    with bar("demonstrations of the twin", 1) as step:
        step("making")
        seeds = range(FIRST_SEED, FIRST_SEED + plan["seeds"])
        episodes = held_out(tasks, seeds, world.description.image_height_px)
    copied = CopyFirstWorld.beside(world.description)
    worlds: dict[str, World[Any]] = {COPY_FIRST: copied, **variants}
    errors = {name: rollout_error(imagine(one, episodes), episodes) for name, one in worlds.items()}
    imagining = {name: partial(imagine, one, episodes) for name, one in worlds.items()}
    times_ms = _times_ms(imagining, "steps and precision", plan["rounds"], bar)
    costs_ms = _costs_ms(world, episodes[:1], TOGETHER, plan["rounds"], bar)
    state_model = options.state_model or PRETRAINED / STATE_MODEL
    state_world = StateWorld(read_state_checkpoint(state_model))
    state_ms = _state_costs_ms(state_world, plan["rounds"], bar)
    return StageReport(
        stage="world-model",
        packages=("numpy", "torch", "mujoco-core"),
        options={**plan, "tasks": tasks, "checkpoint": world.description.name, "served": served},
        tables=[
            error_table(times_ms, errors, served, len(episodes)),
            ResultTable(
                f"{served}: a chunk of one rollout, by requested images and batch size",
                ("requested", "ms"),
                [(name, figure.text()) for name, figure in costs_ms.items()],
            ),
            state_model_table(state_ms, state_world.description.name),
        ],
        panels=panels(times_ms, errors, served),
        requirements=requirements(times_ms, errors, served) + state_model_requirements(state_ms),
        data={
            "chunk_ms": times_ms,
            "errors": errors,
            "requested_ms": costs_ms,
            "state_model_ms": state_ms,
        },
        notes=[
            "times are processor time of the whole process; OMP_NUM_THREADS=1 gives one thread",
            "every chunk starts from the predicted end of the previous one",
        ],
    )


def _times_ms(
    imagining: Mapping[str, Callable[[], Imagined]], what: str, num_rounds: int, bar: Bar
) -> dict[str, Figure]:
    subjects = {name: every_round(measured) for name, measured in imagining.items()}
    with bar(what, num_rounds * len(subjects)) as step:
        found = interleaved(subjects, num_rounds, on_step=step)
    return {name: Figure.of([one.ms for one in rounds]) for name, rounds in found.items()}


def _state_costs_ms(world: StateWorld, num_rounds: int, bar: Bar) -> dict[str, Figure]:
    """Milliseconds per chunk of the state model, with one demonstration of each of its tasks."""
    tasks = [task for task in TASK_NAMES if task in world.description.tasks]
    episodes = held_out(tasks, [FIRST_SEED], world.description.image_height_px)
    # Choice of precision, memory of the first images, and traces.
    for selector in SELECTORS.values():
        imagine_together(world, episodes, 1, selector)
    return _costs_ms(world, episodes, STATE_BATCHES, num_rounds, bar)


def _costs_ms(
    world: BatchWorld[Any],
    episodes: Sequence[HeldOut],
    batches: Sequence[int],
    num_rounds: int,
    bar: Bar,
) -> dict[str, Figure]:
    """Milliseconds per chunk of one rollout, by requested images and batch size."""
    imagining = {
        cost_name(amount, count): partial(imagine_together, world, episodes, count, selector)
        for count in batches
        for amount, selector in SELECTORS.items()
    }
    return _times_ms(imagining, "requested images and batch sizes", num_rounds, bar)
