"""Recording of ground-truth episodes: all streams of one take, scripted or played, and success."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final, cast

import numpy as np
from jaxtyping import Float64, Int64, Shaped

from dextouch.episodes import EpisodeStore
from dextouch.geometry import pose_from_transform, transform_from_pose
from dextouch.hands import NUM_KEYPOINTS
from dextouch.hands.actions import (
    ACTION_DIM,
    AnchorPoses,
    HandTrajectory,
    actions_from_poses,
    poses_from_actions,
)
from dextouch.schemas import EpisodeAttributes, StoredAnchor, matrix_rows
from dextouch.streams import StreamDescriptor, StreamKind
from dextouch.tactile.layout import NUM_TAXELS, SIDES, Side
from services.twin.demonstrators import NUM_GRID_STEPS, MotionScene, with_motion
from services.twin.hands import HumanHand
from services.twin.mistakes import with_mistakes
from services.twin.scene import PHYSICS_RATE_HZ, object_boxes_m
from services.twin.simulation import MODEL_RATE_HZ, STEPS_PER_GRID
from services.twin.stage import Plan, Stage, command_row
from services.twin.take_options import PlayedActions, TakeOptions, episode_id

__all__ = ["PlayedActions", "TakeOptions", "TruthEpisode", "episode_id", "record", "write_episode"]

# Random stream of motions, independent of those of `Stage.plan`.
_MOTION: Final = 101
TACTILE_RATE_HZ: Final = 60
POSE_RATE_HZ: Final = 100
KEYPOINT_RATE_HZ: Final = 120
IMAGE_RATE_HZ: Final = 30
# Number of final grid steps that always have images, since the success classifier needs them.
NUM_LAST_SHOWN_STEPS: Final = 3
_NS_PER_S: Final = 1_000_000_000
Source = Callable[[], np.ndarray]


@dataclass(frozen=True)
class TruthStream:
    """A recorded stream."""

    descriptor: StreamDescriptor
    t_ref_ns: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."]


@dataclass(frozen=True)
class TruthEpisode:
    """Ground truth of one take.

    `pad_forces_n` is the true normal force on thumb … little tip and palm at the tactile rate, left
    then right; pressures times taxel areas sum to it.
    """

    attributes: EpisodeAttributes
    streams: dict[str, TruthStream]
    pad_forces_n: Float64[np.ndarray, "samples 2 6"]


def record(
    stage: Stage, seed: int, options: TakeOptions, *, played: PlayedActions | None = None
) -> TruthEpisode:
    """Record a take, deterministically; `played` actions replace those of the options."""
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
    # When each milestone is first reached; those never reached are absent.
    times_s: dict[str, float] = {}
    _note(stage, 0, times_s)
    for row in range(1, NUM_GRID_STEPS):
        for step_index in stage.simulation.advance(command_row(commands, row)):
            recorder.sample(step_index)
        grid.sample()
        _note(stage, row, times_s)
    streams = recorder.streams()
    streams["action"] = action_stream("action", actions_from_poses(grid.trajectory(), anchor))
    if stage.domain == "robot":
        streams["action_commanded"] = action_stream("action_commanded", actions_commanded)
    found: dict[str, object] = {"event_times_s": times_s}
    if played is not None:
        name = episode_id(stage.task.name, stage.domain, seed, options, played=played.name)
        quality = options.figures() | {"played": 1.0}
        found |= {"episode_id": name, "generator_command": played.command, "quality": quality}
    attributes = _attributes(stage, seed, options, anchor).model_copy(update=found)
    return TruthEpisode(attributes, streams, np.stack(recorder.pad_forces_n))


def _note(stage: Stage, step: int, times_s: dict[str, float]) -> None:
    reached = stage.task.reached(stage.simulation)
    for name, holds in zip(stage.task.milestones, reached, strict=True):
        if holds:
            times_s.setdefault(name, step / MODEL_RATE_HZ)


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
    """Write an episode to a store and return its id; raises ConflictError if the id exists."""
    with store.writer(kind="episode", attributes=episode.attributes) as writer:
        for name, stream in episode.streams.items():
            writer.add_stream(stream.descriptor)
            writer.append(name, values=stream.values, t_ref_ns=stream.t_ref_ns)
    return episode.attributes.episode_id


class Recorder:
    """Records the ground truth of one take; call `sample` at every physics step from step 0."""

    def __init__(self, stage: Stage, options: TakeOptions) -> None:
        self._stage, self._every = stage, options.image_every
        self._sources = {
            descriptor.name: (descriptor, s) for descriptor, s in _sources(stage, options)
        }
        self._samples: dict[str, list[np.ndarray]] = {name: [] for name in self._sources}
        self._due: dict[int, list[str]] = {}
        self.pad_forces_n: list[np.ndarray] = []
        for name, (descriptor, _) in self._sources.items():
            if descriptor.kind == "image" and self._every is not None:
                steps = [step * STEPS_PER_GRID for step in image_steps(self._every)]
            else:
                period = PHYSICS_RATE_HZ // round(descriptor.nominal_rate_hz)
                steps = list(range(0, NUM_GRID_STEPS * STEPS_PER_GRID, period))
            for step_index in steps:
                self._due.setdefault(step_index, []).append(name)

    def sample(self, step_index: int) -> None:
        """Record the samples due at this physics step."""
        for name in self._due.get(step_index, ()):
            self._samples[name].append(np.array(self._sources[name][1]()))
        if step_index % (PHYSICS_RATE_HZ // TACTILE_RATE_HZ) == 0:
            self.pad_forces_n.append(self._stage.simulation.pad_forces_n.copy())

    def streams(self) -> dict[str, TruthStream]:
        """All streams recorded so far, by name."""
        finished = {}
        for name, (descriptor, _) in self._sources.items():
            values = np.stack(self._samples[name])
            if descriptor.kind == "keypoints":
                values = self._keypoints(descriptor, values)
            if descriptor.kind == "image" and self._every is not None:
                image_ns = _regular_ns(NUM_GRID_STEPS, MODEL_RATE_HZ)[image_steps(self._every)]
                finished[name] = TruthStream(descriptor, image_ns[: len(values)], values)
            else:
                finished[name] = timed_stream(descriptor, values)
        return finished

    def _keypoints(self, descriptor: StreamDescriptor, joints_rad: np.ndarray) -> np.ndarray:
        hands = {hand.side: hand.kinematics for hand in self._stage.simulation.scene.hands}
        human = cast("HumanHand", hands[cast("Side", descriptor.side)])
        return human.keypoints_m(joints_rad)


def _sources(stage: Stage, options: TakeOptions) -> list[tuple[StreamDescriptor, Source]]:
    simulation, rig = stage.simulation, stage.rig
    found: list[tuple[StreamDescriptor, Source]] = [
        (
            _descriptor(f"tactile_{side}", "tactile", "kPa", (NUM_TAXELS,), TACTILE_RATE_HZ),
            partial(_of_hand, lambda: simulation.tactile_kpa, index),
        )
        for index, side in enumerate(SIDES)
    ]
    # For training, sampled at the grid steps to avoid interpolation.
    rate_hz: int | float = POSE_RATE_HZ if options.streams == "all" else MODEL_RATE_HZ
    shape = (len(stage.task.object_names), 7)
    objects = _descriptor("object_poses", "pose", "pose_m_wxyz", shape, rate_hz)
    found.append((objects, simulation.object_poses))
    if options.streams == "all":
        found += _hand_sources(stage)
    every = options.image_every
    rate_hz = IMAGE_RATE_HZ if every is None else MODEL_RATE_HZ / every
    for camera in options.images:
        images = _descriptor(camera, "image", "rgb8", (*rig.shape_px, 3), rate_hz)
        found.append((images, partial(rig.image, simulation, camera)))
    return found


def _hand_sources(stage: Stage) -> list[tuple[StreamDescriptor, Source]]:
    """Poses of head and wrists, and joint angles, which become the keypoints of human hands."""
    simulation, is_robot = stage.simulation, stage.domain == "robot"

    def pose(name: str, source: Source) -> tuple[StreamDescriptor, Source]:
        return _descriptor(name, "pose", "pose_m_wxyz", (7,), POSE_RATE_HZ), source

    found = [pose("head", simulation.head_pose)]
    for index, side in enumerate(SIDES):
        found.append(pose(f"wrist_{side}", partial(_of_hand, simulation.wrist_poses, index)))
        if is_robot:
            commanded = partial(_of_hand, simulation.commanded_poses, index)
            found.append(pose(f"wrist_{side}_commanded", commanded))
        else:
            name, shape = f"keypoints_{side}", (NUM_KEYPOINTS, 3)
            keypoints = _descriptor(name, "keypoints", "m", shape, KEYPOINT_RATE_HZ)
            found.append((keypoints, partial(_of_hand, simulation.joints_rad, index)))
    if is_robot:
        sources = {"measured": simulation.joints_rad, "commanded": simulation.commanded_joints_rad}
        for name, source in sources.items():
            joints = _descriptor(f"joints_{name}", "robot_state", "rad", (40,), POSE_RATE_HZ)
            found.append((joints, partial(_flat, source)))
    return found


def _of_hand(source: Source, index: int) -> np.ndarray:
    return source()[index]


def _flat(source: Source) -> np.ndarray:
    return source().ravel()


def _descriptor(
    name: str, kind: StreamKind, unit: str, shape: tuple[int, ...], rate_hz: int | float
) -> StreamDescriptor:
    sides = [side for side in SIDES if f"_{side}" in name]
    return StreamDescriptor(
        name=name,
        kind=kind,
        shape=shape,
        dtype="float32" if kind == "tactile" else "uint8" if kind == "image" else "float64",
        unit=unit,
        nominal_rate_hz=rate_hz,
        frame=f"wrist_{sides[0]}" if kind == "keypoints" else "world" if kind == "pose" else None,
        side=sides[0] if sides else None,
    )


def action_stream(name: str, actions: np.ndarray) -> TruthStream:
    """Actions [81, 67] on the model grid as a stream."""
    descriptor = _descriptor(name, "robot_state", "action_m_rad", (ACTION_DIM,), MODEL_RATE_HZ)
    return timed_stream(descriptor, actions)


def timed_stream(descriptor: StreamDescriptor, values: np.ndarray) -> TruthStream:
    """A stream that starts at time 0 with its exact nominal rate."""
    t_ref_ns = _regular_ns(len(values), round(descriptor.nominal_rate_hz))
    return TruthStream(descriptor, t_ref_ns, values)


def _regular_ns(num_samples: int, rate_hz: int) -> Int64[np.ndarray, " n"]:
    return (np.arange(num_samples, dtype=np.int64) * _NS_PER_S + rate_hz // 2) // rate_hz


def image_steps(image_every: int) -> list[int]:
    """Grid steps with images: multiples of `image_every` and the last three."""
    last = range(NUM_GRID_STEPS - NUM_LAST_SHOWN_STEPS, NUM_GRID_STEPS)
    return sorted({*range(0, NUM_GRID_STEPS, image_every), *last})


class GridLog:
    """Collects measured poses and joints at grid steps as a trajectory."""

    def __init__(self, stage: Stage) -> None:
        self._simulation = stage.simulation
        self._wrists: list[np.ndarray] = []
        self._heads: list[np.ndarray] = []
        self._joints: list[np.ndarray] = []

    def sample(self) -> None:
        """Record the current measurements."""
        self._wrists.append(self._simulation.wrist_poses())
        self._heads.append(self._simulation.head_pose())
        self._joints.append(self._simulation.joints_rad())

    def trajectory(self) -> HandTrajectory:
        """Trajectory of all recorded steps."""
        left, right = np.swapaxes(transform_from_pose(np.stack(self._wrists)), 0, 1)
        joints_left, joints_right = np.swapaxes(np.stack(self._joints), 0, 1)
        head = transform_from_pose(np.stack(self._heads))
        return HandTrajectory(left, right, joints_left, joints_right, head)
