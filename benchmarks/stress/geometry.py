"""Stress of rotations, transforms and actions; expected values are closed forms."""

import numpy as np

from benchmarks.stress.cells import Check, StageCells, bfloat16
from dextouch.errors import DegenerateRotationError, InvalidInputError, NonFiniteError
from dextouch.geometry import transform
from dextouch.geometry.rotations import (
    quaternion_from_rotation,
    rotation_angle,
    rotation_from_6d,
    rotation_from_quaternion,
    rotation_from_vector,
    rotation_to_6d,
    vector_from_rotation,
)
from dextouch.hands.actions import (
    IDENTITY_POSE_9D,
    HandTrajectory,
    actions_from_poses,
    check_actions,
    poses_from_actions,
    reanchor,
)

STAGE = StageCells("geometry")
CHUNK_STEPS, NUM_CHUNKS = 16, 63
# A general axis, and those at which Shepperd's method switches its divisor.
_AXES = np.array([[0.6, 0.0, 0.8], [1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [-0.36, 0.48, 0.8]])
_SMALL_RAD = (0.0, 5e-324, 1e-300, 1e-12, 1e-8, 9.99e-4, 1e-3, 1.001e-3, 2e-3)
_TURNS_RAD = (0.1, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-8, np.pi)
_BEYOND_RAD = (np.pi + 1e-8, np.pi + 1e-3, 4.0, 2 * np.pi - 1e-8, 7.0)


@STAGE.cell("rotations", "angles 0, 5e-324 … π … 7 rad about five axes; columns with sine 5e-7")
def _rotations(check: Check) -> None:
    angles = np.array([*_SMALL_RAD, *_TURNS_RAD])
    vectors = (angles[:, None, None] * _AXES).reshape(-1, 3)
    R = rotation_from_vector(vectors)
    found = vector_from_rotation(R)
    # At π both signs of the axis are the same rotation.
    same, opposite = (np.linalg.norm(found - sign * vectors, axis=1) for sign in (1, -1))
    is_half_turn = np.linalg.norm(vectors, axis=1) > 3.1415926
    same = np.where(is_half_turn, np.minimum(same, opposite), same)
    check.at_most("there and back", same.max(), 1e-7, "rad")
    far = rotation_from_vector((np.array(_BEYOND_RAD)[:, None, None] * _AXES).reshape(-1, 3))
    beyond = rotation_angle(far).reshape(len(_BEYOND_RAD), -1)
    expected = np.abs((np.array(_BEYOND_RAD) + np.pi) % (2 * np.pi) - np.pi)
    check.at_most("angles beyond π fold", np.abs(beyond - expected[:, None]).max(), 1e-7, "rad")
    every = np.concatenate([R, far])
    in_range = (rotation_angle(every) >= 0).all() and (rotation_angle(every) <= np.pi + 1e-15).all()
    check.true("angles in 0 … π", in_range)
    check.true("quaternions with w ≥ 0", (quaternion_from_rotation(every)[:, 0] >= 0).all())
    orthogonal = np.abs(np.swapaxes(every, 1, 2) @ every - np.eye(3)).max()
    check.at_most("RᵀR - 1", orthogonal, 1e-14)
    thin = rotation_from_6d(np.array([1.0, 0, 0, 1.0, 2e-6, 0]))
    check.at_most("columns of sine 2e-6", np.abs(thin - np.eye(3)).max(), 1e-9)
    for what, columns in (
        ("sine 5e-7", [1.0, 0, 0, 1.0, 5e-7, 0]),
        ("opposite columns", [1.0, 0, 0, -1.0, 0, 0]),
        ("zero column", [0.0, 0, 0, 0, 1.0, 0]),
    ):
        check.refused(what, rotation_from_6d, np.array(columns), kind=DegenerateRotationError)
    check.refused(
        "zero quaternion", rotation_from_quaternion, np.zeros(4), kind=DegenerateRotationError
    )


@STAGE.cell("non_finite", "NaN and ±infinity in each input; columns of 5e-324 and 1e308")
def _non_finite(check: Check) -> None:
    for bad in (np.nan, np.inf, -np.inf):
        for what, call, size in (
            ("6-D", rotation_from_6d, 6),
            ("quaternion", rotation_from_quaternion, 4),
            ("vector", rotation_from_vector, 3),
        ):
            values = np.ones(size)
            values[-1] = bad
            check.refused(f"{bad} in {what}", call, values, kind=NonFiniteError)
    actions = np.zeros((3, 67))
    actions[2, 41] = np.nan
    check.refused("NaN action", check_actions, actions, kind=NonFiniteError)
    for length in (5e-324, 1e-200, 1e308):
        R = rotation_from_6d(np.array([0, length, 0, -length, 0, 0]))
        quarter = np.array([[0, -1.0, 0], [1.0, 0, 0], [0, 0, 1.0]])
        check.at_most(
            "quarter turn from tiny and huge columns off", np.abs(R - quarter).max(), 1e-15
        )


@STAGE.cell("ends", "actions whose pose is the anchor's own; an index at and past the ends")
def _ends(check: Check) -> None:
    trajectory = _circling(17)
    actions = actions_from_poses(trajectory, trajectory.anchor(0))
    moved = reanchor(actions, 16)
    check.equal("pose of the first anchor", actions[0, :9], IDENTITY_POSE_9D)
    check.equal("pose of the last anchor", moved[16, :9], IDENTITY_POSE_9D)
    for index in (-1, 17):
        check.refused(f"index {index}", reanchor, actions, index, kind=InvalidInputError)


@STAGE.cell("precision", "6-D rotations rounded to bfloat16 and float16")
def _precision(check: Check) -> None:
    vectors = np.random.default_rng(0).normal(size=(200, 3))
    exact = rotation_from_vector(vectors)
    six = rotation_to_6d(exact)
    for name, rounded, bound in (
        ("bfloat16", bfloat16(six), 2.0**-6),
        ("float16", six.astype(np.float16), 2.0**-9),
    ):
        R = rotation_from_6d(rounded)
        check.true(f"{name}: answers float64", R.dtype == np.float64)
        check.at_most(f"{name}: RᵀR - 1", np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(), 1e-14)
        off = rotation_angle(np.swapaxes(exact, 1, 2) @ R).max()
        check.at_most(f"{name}: angle off", off, bound, "rad")


@STAGE.cell("long_run", "1008 steps on a circle, re-anchored at the end of each of 63 chunks")
def _long_run(check: Check) -> None:
    truth = _circling(1 + NUM_CHUNKS * CHUNK_STEPS)
    anchor = truth.anchor(0)
    actions = actions_from_poses(truth, anchor)
    for chunk in range(NUM_CHUNKS):
        first = CHUNK_STEPS * chunk
        rows = reanchor(actions[first : first + CHUNK_STEPS + 1], 0)
        anchor = poses_from_actions(rows, anchor).anchor(CHUNK_STEPS)
    last = truth.anchor(NUM_CHUNKS * CHUNK_STEPS)
    for what, got, expected in zip(
        ("left wrist", "right wrist", "head"), anchor.as_tuple(), last.as_tuple(), strict=True
    ):
        off_m = np.linalg.norm(got[:3, 3] - expected[:3, 3])
        check.at_most(f"{what} off", off_m, 1e-11, "m")
        off_rad = rotation_angle(got[:3, :3].T @ expected[:3, :3])
        check.at_most(f"{what} turned", float(off_rad), 1e-10, "rad")
        check.at_most("RᵀR - 1", np.abs(got[:3, :3].T @ got[:3, :3] - np.eye(3)).max(), 1e-11)


@STAGE.cell("batch", "500 rotations, actions and poses at once and one by one")
def _batch(check: Check) -> None:
    vectors = np.random.default_rng(1).normal(size=(500, 3))
    together = rotation_from_vector(vectors)
    alone = np.stack([rotation_from_vector(one) for one in vectors])
    check.at_most("rotations differ", np.abs(together - alone).max(), 1e-15)
    back = np.stack([vector_from_rotation(one) for one in together])
    check.at_most("vectors differ", np.abs(vector_from_rotation(together) - back).max(), 1e-15)
    trajectory = _circling(64)
    anchor = trajectory.anchor(0)
    actions = actions_from_poses(trajectory, anchor)
    rows = [poses_from_actions(row[None], anchor).Ts_world_wrist_left[0] for row in actions]
    whole = poses_from_actions(actions, anchor).Ts_world_wrist_left
    check.at_most("poses differ", np.abs(whole - np.stack(rows)).max(), 1e-15, "m")


STAGE.does_not_apply(
    one_axis="nothing is estimated from motion here; see hand-eye",
    clock="no times; see clocks",
    touch="no touch; see tactile-calibration",
    device="numpy arrays live in the host's memory",
)


def _circling(num_steps: int) -> HandTrajectory:
    """Wrists and head on circles, rotating about a skew axis: closed-form poses."""
    phase = np.linspace(0.0, 20.0, num_steps)
    axis = np.array([0.48, -0.6, 0.64])

    def part(radius_m: float, rate: float, start_rad: float) -> np.ndarray:
        angle = rate * phase + start_rad
        place = np.stack([np.cos(angle), np.sin(angle), 0.1 * np.sin(3 * angle)], axis=1)
        return transform(rotation_from_vector(angle[:, None] * axis), radius_m * place)

    joints = 0.5 + 0.4 * np.sin(phase[:, None] + np.arange(20))
    return HandTrajectory(
        part(0.2, 1.0, 0.0), part(0.3, -0.7, 1.0), joints, joints, part(0.1, 0.3, 2.0)
    )
