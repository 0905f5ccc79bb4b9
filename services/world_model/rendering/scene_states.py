"""Scene states that a renderer draws: head camera, both hands and every object at one step."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64

from dextouch.errors import NonFiniteError, ShapeError

# Slots of the renderer's inputs, which its weights are trained with; one more than tasks may have.
MAX_DRAWN_OBJECTS = 4


@dataclass(frozen=True)
class SceneState:
    """Poses at one step; slots of absent objects hold arbitrary finite numbers."""

    T_world_camera: Float64[np.ndarray, "4 4"]
    Ts_world_wrist: Float64[np.ndarray, "2 4 4"]
    joints_rad: Float64[np.ndarray, "2 20"]
    object_poses: Float64[np.ndarray, "k 7"]
    object_present: Bool[np.ndarray, " k"]


@dataclass(frozen=True)
class SceneStates:
    """Many states as arrays; poses are x y z (m), then the quaternion w x y z, in the world."""

    Ts_world_camera: Float64[np.ndarray, "n 4 4"]
    Ts_world_wrist: Float64[np.ndarray, "n 2 4 4"]
    joints_rad: Float64[np.ndarray, "n 2 20"]
    object_poses: Float64[np.ndarray, "n k 7"]
    object_present: Bool[np.ndarray, "n k"]

    @classmethod
    def stack(cls, states: Sequence[SceneState]) -> "SceneStates":
        """Stack states with the same number of object slots.

        Raises:
            ShapeError: no state, arrays of another shape, or more than four slots.
            NonFiniteError: NaN or infinity.
        """
        if not states:
            raise ShapeError("scene states: got none, expected at least one to draw")
        shapes = {(np.shape(s.object_poses), np.shape(s.object_present)) for s in states}
        num_slots = len(states[0].object_present)
        if shapes != {((num_slots, 7), (num_slots,))} or num_slots > MAX_DRAWN_OBJECTS:
            raise ShapeError(
                f"scene states: got object poses and presences of shapes {sorted(shapes)}, "
                f"expected [K, 7] and [K] with one K ≤ {MAX_DRAWN_OBJECTS} in all of them"
            )
        made = cls(
            np.stack([np.asarray(s.T_world_camera, dtype=np.float64) for s in states]),
            np.stack([np.asarray(s.Ts_world_wrist, dtype=np.float64) for s in states]),
            np.stack([np.asarray(s.joints_rad, dtype=np.float64) for s in states]),
            np.stack([np.asarray(s.object_poses, dtype=np.float64) for s in states]),
            np.stack([np.asarray(s.object_present, dtype=np.bool_) for s in states]),
        )
        made._check()
        return made

    @classmethod
    def joined(cls, parts: "Sequence[SceneStates]") -> "SceneStates":
        """All states of the parts, which have equal numbers of object slots."""
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def __len__(self) -> int:
        return len(self.Ts_world_camera)

    def padded(self, num_slots: int) -> "SceneStates":
        """The same states with absent objects in further slots, `num_slots` in all."""
        count = self.object_present.shape[1]
        poses = np.zeros((len(self), num_slots, 7))
        poses[..., 3] = 1.0
        poses[:, :count] = self.object_poses
        present = np.zeros((len(self), num_slots), dtype=np.bool_)
        present[:, :count] = self.object_present
        return replace(self, object_poses=poses, object_present=present)

    def take(self, rows: Int64[np.ndarray, " m"]) -> "SceneStates":
        """Select states, in the order of `rows`."""
        return SceneStates(
            self.Ts_world_camera[rows],
            self.Ts_world_wrist[rows],
            self.joints_rad[rows],
            self.object_poses[rows],
            self.object_present[rows],
        )

    def _check(self) -> None:
        expected = {
            "T_world_camera": (self.Ts_world_camera, (4, 4)),
            "Ts_world_wrist": (self.Ts_world_wrist, (2, 4, 4)),
            "joints_rad": (self.joints_rad, (2, 20)),
            "object_poses": (self.object_poses, self.object_poses.shape[1:]),
        }
        for name, (array, shape) in expected.items():
            if array.shape[1:] != shape:
                raise ShapeError(f"scene state: {name} is {array.shape[1:]}, expected {shape}")
            bad = np.flatnonzero(~np.isfinite(array).all(axis=tuple(range(1, array.ndim))))
            if len(bad):
                raise NonFiniteError(
                    f"scene state {bad[0]}: {name} contains NaN or infinity; expected finite values"
                )
