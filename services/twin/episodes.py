"""Recording of ground-truth episodes: all streams of one take, scripted or played, and success."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.episodes import EpisodeStore
from dextouch.geometry import pose_from_transform, transform_from_pose
from dextouch.hands.actions import AnchorPoses, actions_from_poses, poses_from_actions
from dextouch.schemas import EpisodeAttributes, StoredAnchor, matrix_rows
from services.twin.bounding_boxes import object_boxes_m
from services.twin.demonstrators import NUM_GRID_STEPS
from services.twin.mistakes import with_mistakes
from services.twin.motions import MotionScene, with_motion
from services.twin.recorder import EventTimes, GridLog, Recorder, TruthStream, action_stream
from services.twin.simulation import MODEL_RATE_HZ, STEPS_PER_GRID
from services.twin.stage import Plan, Stage, command_row
from services.twin.take_options import PlayedActions, TakeOptions, episode_id

__all__ = [
    "TAKE_STEPS",
    "PlayedActions",
    "TakeOptions",
    "TruthEpisode",
    "episode_id",
    "record",
    "write_episode",
]

TAKE_STEPS: Final = (NUM_GRID_STEPS - 1) * STEPS_PER_GRID
# Random stream of motions, independent of those of `Stage.plan`.
_MOTION: Final = 101


@dataclass(frozen=True)
class TruthEpisode:
    """Ground truth of one take.

    `pad_forces_n` is the true contact force at the tactile rate: normal force on thumb … little tip
    and palm, left then right; pressures times taxel areas sum to it.
    """

    attributes: EpisodeAttributes
    streams: dict[str, TruthStream]
    pad_forces_n: Float64[np.ndarray, "samples 2 6"]


def record(
    stage: Stage, seed: int, options: TakeOptions, *, played: PlayedActions | None = None
) -> TruthEpisode:
    """Record one take; equal stage, seed, options and actions give equal bytes.

    Args:
        stage: a task with the hands of a domain.
        seed: seed of the scene and of all random numbers.
        options: options of the take; they determine the commands unless `played` is given.
        played: actions from another source.
    """
    sizes = options.sizes
    plan = stage.plan(
        seed, noise_m=options.noise_m, miss=options.miss, varied=options.varied, sizes=sizes
    )
    stage.dress(seed, varied=options.varied, sizes=sizes)
    anchor = stage.start(plan)
    # Commands are converted to 67-D and back, so that the take exactly follows its
    # `action_commanded`.
    if played is None:
        actions_commanded = _commanded(stage, seed, options, plan, anchor)
    else:
        actions_commanded = np.asarray(played.actions, dtype=np.float64)
    commands = poses_from_actions(actions_commanded, anchor)
    recorder, grid = Recorder(stage, options), GridLog(stage)
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
    found: dict[str, object] = {"event_times_s": events.times_s}
    if played is not None:
        name = episode_id(stage.task.name, stage.domain, seed, options, played=played.name)
        quality = options.figures() | {"played": 1.0}
        found |= {"episode_id": name, "generator_command": played.command, "quality": quality}
    attributes = _attributes(stage, seed, options, anchor).model_copy(update=found)
    return TruthEpisode(attributes, streams, np.stack(recorder.pad_forces_n))


def _commanded(
    stage: Stage, seed: int, options: TakeOptions, plan: Plan, anchor: AnchorPoses
) -> Float64[np.ndarray, "81 67"]:
    """Commanded 67-D actions, relative to the measured poses at the start."""
    if options.actions_of_seed is not None:
        other = stage.plan(options.actions_of_seed, noise_m=options.noise_m).commands
        # Measured at the start of that take, where the hands are at the first command.
        Ts = transform_from_pose(pose_from_transform(np.stack(other.anchor(0).as_tuple())))
        return actions_from_poses(other, AnchorPoses(*Ts))
    commands = plan.commands
    scene = MotionScene(stage.domain, plan.object_poses)
    if options.mistakes:
        commands = with_mistakes(commands, options.mistakes, scene, seed)
    if options.motion is not None:
        draw = np.random.default_rng([seed, _MOTION])
        commands = with_motion(commands, options.motion, scene, draw)
    actions = actions_from_poses(commands, anchor)
    if options.frozen_from_step is not None:
        actions[options.frozen_from_step :] = actions[options.frozen_from_step]
    return actions


def _attributes(
    stage: Stage, seed: int, options: TakeOptions, anchor: AnchorPoses
) -> EpisodeAttributes:
    mounts = {
        f"T_wrist_{hand.side}_camera_wrist_{hand.side}": matrix_rows(mount)
        for hand, mount in zip(stage.simulation.scene.hands, stage.rig.mounts, strict=True)
    }
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
            f"--seeds {seed}:{seed + 1} {' '.join(options.words())}"
        ),
        object_names=stage.task.object_names,
        object_boxes_m=tuple(
            (x, y, z, half_x, half_y, half_z)
            for x, y, z, half_x, half_y, half_z in object_boxes_m(stage.simulation.scene).tolist()
        ),
        calibration=mounts,
        quality=options.figures(),
    )


def write_episode(store: EpisodeStore, episode: TruthEpisode) -> str:
    """Write an episode to a store and return its id.

    Raises:
        ConflictError: the id exists.
    """
    with store.writer(kind="episode", attributes=episode.attributes) as writer:
        for name, stream in episode.streams.items():
            writer.add_stream(stream.descriptor)
            writer.append(name, values=stream.values, t_ref_ns=stream.t_ref_ns)
    return episode.attributes.episode_id
