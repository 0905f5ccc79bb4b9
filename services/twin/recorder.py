"""Recorder of a simulation's ground-truth streams, each sampled at its own rate."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final, cast

import numpy as np
from jaxtyping import Int64, Shaped

from dextouch.geometry import transform_from_pose
from dextouch.hands import NUM_KEYPOINTS
from dextouch.hands.actions import ACTION_DIM, HandTrajectory
from dextouch.streams import StreamDescriptor, StreamKind
from dextouch.tactile.layout import NUM_TAXELS, SIDES, Side
from services.twin.demonstrators import NUM_GRID_STEPS
from services.twin.hands import HumanHand
from services.twin.mjcf import PHYSICS_RATE_HZ
from services.twin.simulation import MODEL_RATE_HZ, STEPS_PER_GRID, Simulation
from services.twin.stage import Stage
from services.twin.take_options import TakeOptions
from services.twin.tasks import Task

TACTILE_RATE_HZ: Final = 60
POSE_RATE_HZ: Final = 100
KEYPOINT_RATE_HZ: Final = 120
IMAGE_RATE_HZ: Final = 30
# Number of final grid steps that always have images, since the success classifier needs them.
NUM_LAST_SHOWN_STEPS: Final = 3
_NS_PER_S: Final = 1_000_000_000


@dataclass(frozen=True)
class TruthStream:
    """A recorded stream."""

    descriptor: StreamDescriptor
    t_ref_ns: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."]


def _descriptor(
    name: str, kind: StreamKind, unit: str, shape: tuple[int, ...], rate_hz: int | float
) -> StreamDescriptor:
    dtype = {"tactile": "float32", "image": "uint8"}.get(kind, "float64")
    sides = [side for side in SIDES if f"_{side}" in name and name != "joints"]
    frame = f"wrist_{sides[0]}" if kind == "keypoints" else "world" if kind == "pose" else None
    return StreamDescriptor.model_validate(
        {
            "name": name,
            "kind": kind,
            "shape": shape,
            "dtype": dtype,
            "unit": unit,
            "nominal_rate_hz": rate_hz,
            "frame": frame,
            "side": sides[0] if sides else None,
        }
    )


def _flat(source: Callable[[], np.ndarray]) -> np.ndarray:
    return source().ravel()


class Recorder:
    """Records the ground truth of one take; call `sample` at every physics step from step 0."""

    def __init__(self, stage: Stage, options: TakeOptions) -> None:
        self._stage = stage
        self._sources: dict[str, tuple[StreamDescriptor, Callable[[], np.ndarray]]] = {}
        self._samples: dict[str, list[np.ndarray]] = {}
        self._due: dict[int, list[str]] = {}
        self._every = options.image_every
        self.pad_forces_n: list[np.ndarray] = []
        self._add_touch()
        # For training, sampled at the grid steps to avoid interpolation.
        self._add_objects(POSE_RATE_HZ if options.streams == "all" else MODEL_RATE_HZ)
        if options.streams == "all":
            self._add_hands()
        for camera in options.images:
            self._add_camera(camera)

    def _add(self, descriptor: StreamDescriptor, source: Callable[[], np.ndarray]) -> None:
        self._sources[descriptor.name] = (descriptor, source)
        self._samples[descriptor.name] = []
        if descriptor.kind == "image" and self._every is not None:
            steps = [step * STEPS_PER_GRID for step in shown_steps(self._every)]
        else:
            period = PHYSICS_RATE_HZ // round(descriptor.nominal_rate_hz)
            steps = list(range(0, NUM_GRID_STEPS * STEPS_PER_GRID, period))
        for step_index in steps:
            self._due.setdefault(step_index, []).append(descriptor.name)

    def _add_touch(self) -> None:
        for index, side in enumerate(SIDES):
            self._add(
                _descriptor(f"tactile_{side}", "tactile", "kPa", (NUM_TAXELS,), TACTILE_RATE_HZ),
                partial(self._tactile, index),
            )

    def _add_objects(self, rate_hz: int) -> None:
        num_objects = len(self._stage.task.object_names)
        self._add(
            _descriptor("object_poses", "pose", "pose_m_wxyz", (num_objects, 7), rate_hz),
            self._stage.simulation.object_poses,
        )

    def _tactile(self, side_index: int) -> np.ndarray:
        return self._stage.simulation.tactile_kpa[side_index]

    def _wrist(self, side_index: int) -> np.ndarray:
        return self._stage.simulation.wrist_poses()[side_index]

    def _wrist_commanded(self, side_index: int) -> np.ndarray:
        return self._stage.simulation.commanded_poses()[side_index]

    def _add_pose(self, name: str, source: Callable[[], np.ndarray]) -> None:
        self._add(_descriptor(name, "pose", "pose_m_wxyz", (7,), POSE_RATE_HZ), source)

    def _add_hands(self) -> None:
        simulation = self._stage.simulation
        self._add_pose("head", simulation.head_pose)
        for index, side in enumerate(SIDES):
            self._add_pose(f"wrist_{side}", partial(self._wrist, index))
            if self._stage.domain == "robot":
                self._add_pose(
                    f"wrist_{side}_commanded",
                    partial(self._wrist_commanded, index),
                )
            else:
                self._add_keypoints(side, index)
        if self._stage.domain == "robot":
            sources = (simulation.joints_rad, simulation.commanded_joints_rad)
            for name, source in zip(("measured", "commanded"), sources, strict=True):
                self._add(
                    _descriptor(f"joints_{name}", "robot_state", "rad", (40,), POSE_RATE_HZ),
                    partial(_flat, source),
                )

    def _add_keypoints(self, side: Side, index: int) -> None:
        """Record joint angles, which are converted to keypoints at the end."""
        simulation = self._stage.simulation
        self._add(
            _descriptor(
                f"keypoints_{side}", "keypoints", "m", (NUM_KEYPOINTS, 3), KEYPOINT_RATE_HZ
            ),
            lambda: simulation.joints_rad()[index],
        )

    def _add_camera(self, camera: str) -> None:
        simulation, rig = self._stage.simulation, self._stage.rig
        rate_hz = IMAGE_RATE_HZ if self._every is None else MODEL_RATE_HZ / self._every
        self._add(
            _descriptor(camera, "image", "rgb8", (*rig.shape_px, 3), rate_hz),
            lambda: rig.image(simulation, camera),
        )

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
                shown_ns = _regular_ns(NUM_GRID_STEPS, MODEL_RATE_HZ)[shown_steps(self._every)]
                finished[name] = TruthStream(descriptor, shown_ns[: len(values)], values)
            else:
                finished[name] = timed_stream(descriptor, values)
        return finished

    def _keypoints(self, descriptor: StreamDescriptor, joints_rad: np.ndarray) -> np.ndarray:
        hands = {hand.side: hand.kinematics for hand in self._stage.simulation.scene.hands}
        human = cast("HumanHand", hands[cast("Side", descriptor.side)])
        return human.keypoints_m(joints_rad)


def timed_stream(descriptor: StreamDescriptor, values: np.ndarray) -> TruthStream:
    """A stream that starts at time 0 with its exact nominal rate."""
    t_ref_ns = _regular_ns(len(values), round(descriptor.nominal_rate_hz))
    return TruthStream(descriptor, t_ref_ns, values)


def _regular_ns(num_samples: int, rate_hz: int) -> Int64[np.ndarray, " n"]:
    return (np.arange(num_samples, dtype=np.int64) * _NS_PER_S + rate_hz // 2) // rate_hz


def shown_steps(image_every: int) -> list[int]:
    """Grid steps with images: multiples of `image_every` and the last three."""
    last = range(NUM_GRID_STEPS - NUM_LAST_SHOWN_STEPS, NUM_GRID_STEPS)
    return sorted({*range(0, NUM_GRID_STEPS, image_every), *last})


def action_stream(name: str, actions: np.ndarray) -> TruthStream:
    """Actions [81, 67] on the model grid as a stream."""
    descriptor = _descriptor(name, "robot_state", "action_m_rad", (ACTION_DIM,), MODEL_RATE_HZ)
    return timed_stream(descriptor, actions)


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
        Ts = transform_from_pose(np.stack(self._wrists))
        joints = np.stack(self._joints)
        return HandTrajectory(
            Ts[:, 0],
            Ts[:, 1],
            joints[:, 0],
            joints[:, 1],
            transform_from_pose(np.stack(self._heads)),
        )


# Times at which a task's milestones are first reached in a take.


class EventTimes:
    """Collects the first time of each milestone; those never reached are absent."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self.times_s: dict[str, float] = {}

    def sample(self, step: int, simulation: Simulation) -> None:
        """Record the milestones reached at a grid step, counted from the start of the take."""
        reached = self._task.reached(simulation)
        for name, holds in zip(self._task.milestones, reached, strict=True):
            if holds:
                self.times_s.setdefault(name, step / MODEL_RATE_HZ)
