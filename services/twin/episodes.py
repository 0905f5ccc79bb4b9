"""Truth episodes: task and seed in, every stream of a scripted take with its success out."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.hands.actions import AnchorPoses, actions_from_poses, poses_from_actions
from dextouch.schemas.episodes import EpisodeAttributes, StoredAnchor, matrix_rows
from services.twin.bounding_boxes import object_boxes_m
from services.twin.cameras import CAMERAS
from services.twin.demonstrators import NUM_GRID_STEPS
from services.twin.events import EventTimes
from services.twin.hands import Domain
from services.twin.recorder import GridLog, Recorder, TruthStream, action_stream
from services.twin.settings import TwinSettings
from services.twin.simulation import MODEL_RATE_HZ, STEPS_PER_GRID
from services.twin.stage import Stage, command_row

TAKE_STEPS: Final = (NUM_GRID_STEPS - 1) * STEPS_PER_GRID


@dataclass(frozen=True)
class TruthEpisode:
    """One take as it really was.

    `pad_forces_n` is the contact truth at the tactile rate: normal force on thumb … little tip
    and palm, left then right; pressures times taxel areas sum to it.
    """

    attributes: EpisodeAttributes
    streams: dict[str, TruthStream]
    pad_forces_n: Float64[np.ndarray, "samples 2 6"]


@dataclass(frozen=True)
class TakeOptions:
    """How a demonstration is made, apart from task, domain and seed.

    `noise_m` is the demonstrator's error (0 … 0.2 m), `miss` moves or removes the objects while
    the motion stays, `images` are the cameras to record. From `frozen_from_step` (0 … 80) on the
    commands no longer change: 0 holds still from the start.
    """

    noise_m: float = 0.0
    miss: bool = False
    images: tuple[str, ...] = CAMERAS
    frozen_from_step: int | None = None

    def __post_init__(self) -> None:
        frozen = self.frozen_from_step
        if frozen is not None and not 0 <= frozen < NUM_GRID_STEPS:
            raise InvalidInputError(
                f"twin: got commands frozen from step {frozen}, expected a step "
                f"0 … {NUM_GRID_STEPS - 1}"
            )
        for camera in self.images:
            if camera not in CAMERAS:
                raise UnknownNameError("camera", camera, list(CAMERAS))


def demonstrate(
    task: str,
    seed: int,
    *,
    domain: Domain = "robot",
    noise_m: float = 0.0,
    miss: bool = False,
    images: tuple[str, ...] = CAMERAS,
) -> TruthEpisode:
    """One scripted take from a freshly compiled scene; use `record` for many.

    Raises:
        UnknownNameError: unknown task, domain or camera.
        InvalidInputError: seed or noise out of range.
    """
    return record(Stage(task, domain, TwinSettings()), seed, TakeOptions(noise_m, miss, images))


def record(stage: Stage, seed: int, options: TakeOptions) -> TruthEpisode:
    """One scripted take on a stage; the same stage, seed and options give the same bytes."""
    plan = stage.plan(seed, noise_m=options.noise_m, miss=options.miss)
    anchor = stage.start(plan)
    # The take obeys exactly the numbers that its `action_commanded` holds: through 67-D and back.
    actions_commanded = actions_from_poses(plan.commands, anchor)
    if options.frozen_from_step is not None:
        actions_commanded[options.frozen_from_step :] = actions_commanded[options.frozen_from_step]
    commands = poses_from_actions(actions_commanded, anchor)
    recorder, grid = Recorder(stage, images=options.images), GridLog(stage)
    recorder.sample(0)
    grid.sample()
    events = EventTimes(stage.task)
    events.sample(0, stage.simulation)
    for row in range(1, NUM_GRID_STEPS):
        for step_index in stage.simulation.advance(command_row(commands, row)):
            recorder.sample(step_index)
        grid.sample()
        events.sample(row, stage.simulation)
    streams = recorder.streams()
    streams["action"] = action_stream("action", actions_from_poses(grid.trajectory(), anchor))
    if stage.domain == "robot":
        streams["action_commanded"] = action_stream("action_commanded", actions_commanded)
    attributes = _attributes(stage, seed, options, anchor).model_copy(
        update={"event_times_s": events.times_s}
    )
    return TruthEpisode(attributes, streams, np.stack(recorder.pad_forces_n))


def episode_id(task: str, domain: Domain, seed: int, options: TakeOptions) -> str:
    """A name that tells what is in the episode and differs for every way to make one."""
    parts = ["twin", task, domain, f"{seed:06d}"]
    if options.noise_m > 0:
        parts.append(f"n{round(options.noise_m * 1e6)}um")
    if options.miss:
        parts.append("miss")
    if options.frozen_from_step is not None:
        parts.append(f"f{options.frozen_from_step}")
    return "-".join(parts)


def _attributes(
    stage: Stage, seed: int, options: TakeOptions, anchor: AnchorPoses
) -> EpisodeAttributes:
    mounts = {
        f"T_wrist_{hand.side}_camera_wrist_{hand.side}": matrix_rows(mount)
        for hand, mount in zip(stage.simulation.scene.hands, stage.rig.mounts, strict=True)
    }
    frozen = options.frozen_from_step
    return EpisodeAttributes(
        episode_id=episode_id(stage.task.name, stage.domain, seed, options),
        task=stage.task.name,
        instruction=stage.task.instruction,
        domain=stage.domain,
        origin="twin",
        seed=seed,
        model_rate_hz=MODEL_RATE_HZ,
        anchor=StoredAnchor.from_poses(anchor),
        K_head=matrix_rows(stage.rig.K["camera_head"]),
        success=stage.task.succeeded(stage.simulation),
        generator_command=(
            f"dextouch twin record --task {stage.task.name} --domain {stage.domain} "
            f"--seeds {seed}:{seed + 1} --noise {options.noise_m!r} "
            f"--miss-fraction {float(options.miss)!r}"
            + ("" if frozen is None else f" --freeze-from {frozen}")
        ),
        object_names=stage.task.object_names,
        object_boxes_m=tuple(
            (x, y, z, half_x, half_y, half_z)
            for x, y, z, half_x, half_y, half_z in object_boxes_m(stage.simulation.scene).tolist()
        ),
        calibration=mounts,
        quality={"noise_m": options.noise_m, "miss": float(options.miss)},
    )


def write_episode(store: EpisodeStore, episode: TruthEpisode) -> str:
    """Put a truth episode into a store; returns its id.

    Raises:
        ConflictError: the store has an episode of this id already.
    """
    with store.writer(kind="episode", attributes=episode.attributes) as writer:
        for name, stream in episode.streams.items():
            writer.add_stream(stream.descriptor)
            writer.append(name, values=stream.values, t_ref_ns=stream.t_ref_ns)
    return episode.attributes.episode_id
