"""Faults of known place in movements of known noise, and movements that only look faulty."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from dextouch.errors import InvalidInputError
from dextouch.hands.robot_hand import RobotHand
from dextouch.streams import (
    StreamDescriptor,
    check_camera_matrix,
    implausible_joints,
    implausible_poses,
    implausible_repeats,
    implausible_values,
    lasting_jumps,
)

HANDS = Path(__file__).parents[4] / "shared/data/hands/right_hand_mediapipe_first_half.npy"
RATES_HZ = (30, 60, 120, 250)


def movement(rate_hz, *, seed=0, seconds=8.0, noise_m=0.0005, rests=False):
    """Times (ns) and poses [n, 7] of a tracked hand, with a standstill of 2 s if it `rests`."""
    rng = np.random.default_rng(seed)
    count = round(seconds * rate_hz)

    def smooth(scale):
        waves = gaussian_filter1d(rng.standard_normal((count, 3)), 0.3 * rate_hz, axis=0)
        return scale * waves / waves.std()

    position_m, turn_rad = smooth(0.2), smooth(0.4)
    if rests:
        t_s = np.arange(count + 2 * rate_hz) / rate_hz
        speed = np.interp(t_s, [2.0, 2.5, 4.5, 5.0], [1.0, 0.0, 0.0, 1.0])
        slow = np.minimum(np.cumsum(speed), count - 1)
        position_m, turn_rad = (
            np.stack([np.interp(slow, np.arange(count), axis) for axis in of.T], axis=1)
            for of in (position_m, turn_rad)
        )
        count = len(slow)
    quaternions = Rotation.from_rotvec(turn_rad).as_quat()[:, [3, 0, 1, 2]]
    poses = np.concatenate([position_m, quaternions], axis=1)
    poses[:, :3] += [0.3, 0.5, 1.0] + noise_m * rng.standard_normal((count, 3))
    t_ns = np.rint(np.arange(count) * 1e9 / rate_hz).astype(np.int64)
    return t_ns, poses


def found(t_ns, poses, rate_hz):
    return implausible_poses(t_ns, poses, period_ns=round(1e9 / rate_hz))


@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.parametrize("noise_m", [0.0, 0.0002, 0.003])
@pytest.mark.parametrize("rests", [False, True])
def test_movements_with_and_without_noise_and_rests_are_plausible(rate_hz, noise_m, rests):
    for seed in range(5):
        assert found(*movement(rate_hz, seed=seed, noise_m=noise_m, rests=rests), rate_hz) == []


def test_a_robot_of_coarse_encoders_may_stand_still():
    rate_hz = 100
    t_ns, poses = movement(rate_hz, noise_m=0.0, rests=True)
    poses = np.round(poses, 4)
    period_ns = round(1e9 / rate_hz)
    assert implausible_poses(t_ns, poses, period_ns=period_ns, can_rest=True) == []


def test_the_fastest_throw_is_plausible():
    rate_hz = 120
    t_ns = np.rint(np.arange(240) * 1e9 / rate_hz).astype(np.int64)
    # 8 m/s within 0.25 s, as javelins are thrown, and to a halt in the same time.
    speed_m_s = np.interp(t_ns / 1e9, [0, 0.5, 0.75, 1.0, 2], [0, 0, 8, 0, 0])
    poses = np.zeros((240, 7))
    poses[:, 0], poses[:, 3] = np.cumsum(speed_m_s) / rate_hz, 1.0
    assert [one.cause for one in found(t_ns, poses, rate_hz)] == []


def test_lost_poses_are_none_of_its_business():
    t_ns, poses = movement(60)
    poses[100:110] = np.nan
    poses[200:230, 3:] = 0
    assert found(t_ns, poses, 60) == []
    assert found(t_ns, np.full_like(poses, np.nan), 60) == []


@pytest.mark.parametrize(("rate_hz", "offset_m"), [(30, 0.5), (60, 0.3), (120, 5.0), (250, 0.3)])
@pytest.mark.parametrize("num", [1, 3])
def test_poses_elsewhere_are_located(rate_hz, offset_m, num):
    for seed in range(5):
        t_ns, poses = movement(rate_hz, seed=seed)
        direction = np.random.default_rng(seed).standard_normal(3)
        poses[99 : 99 + num, :3] += offset_m * direction / np.linalg.norm(direction)
        (jump,) = found(t_ns, poses, rate_hz)
        assert jump.cause == "jump"
        assert not jump.whole
        assert np.flatnonzero(jump.samples).tolist() == list(range(99, 99 + num))


@pytest.mark.parametrize(("rate_hz", "offset_m"), [(60, 0.08), (120, 0.03), (250, 0.02)])
def test_a_pose_is_located_by_the_acceleration_that_it_needs(rate_hz, offset_m):
    for seed in range(5):
        t_ns, poses = movement(rate_hz, seed=seed)
        poses[99, 1] += offset_m
        (jump,) = found(t_ns, poses, rate_hz)
        assert np.flatnonzero(jump.samples).tolist() == [99]


def test_a_flipped_rotation_is_located():
    t_ns, poses = movement(60)
    poses[50, 3:] = poses[50, [4, 3, 6, 5]] * [1, -1, 1, -1]
    (jump,) = found(t_ns, poses, 60)
    assert np.flatnonzero(jump.samples).tolist() == [50]


def test_the_sign_of_quaternions_says_nothing():
    t_ns, poses = movement(60)
    poses[::2, 3:] *= -1
    assert found(t_ns, poses, 60) == []


def test_a_tracker_that_finds_itself_anew_is_no_outlier():
    t_ns, poses = movement(60)
    poses[200:, :3] += [0.4, 0, 0]
    assert found(t_ns, poses, 60) == []
    jumps = lasting_jumps(t_ns, poses, period_ns=round(1e9 / 60))
    assert jumps.tolist() == [200]


@pytest.mark.parametrize(
    ("factor", "unit"), [(1000, "millimetres"), (100, "centimetres")], ids=["mm", "cm"]
)
@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_other_units_are_named(rate_hz, factor, unit):
    for seed in range(5):
        t_ns, poses = movement(rate_hz, seed=seed)
        poses[:, :3] *= factor
        (one,) = found(t_ns, poses, rate_hz)
        assert (one.cause, one.whole, one.samples.all()) == ("unit", True, True)
        assert f"these look like {unit}" in one.message


def test_noise_of_decimetres_is_no_unit():
    t_ns, poses = movement(60, noise_m=0.3)
    (one,) = found(t_ns, poses, 60)
    assert (one.cause, one.whole) == ("speed", True)


def test_columns_that_are_no_quaternion():
    t_ns, poses = movement(60)
    poses[:, 3:] = Rotation.from_quat(poses[:, 3:]).as_euler("xyz", degrees=True)[:, [0, 1, 2, 0]]
    (one,) = found(t_ns, poses, 60)
    assert (one.cause, one.whole) == ("norm", True)


@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.parametrize("noise_m", [0.0, 0.0005])
def test_a_frozen_stream_is_located(rate_hz, noise_m):
    for seed in range(5):
        t_ns, poses = movement(rate_hz, seed=seed, noise_m=noise_m)
        poses[100 : 100 + rate_hz] = poses[100]
        frozen = [one for one in found(t_ns, poses, rate_hz) if one.cause == "frozen"]
        assert len(frozen) == 1
        assert np.flatnonzero(frozen[0].samples).tolist() == list(range(101, 100 + rate_hz))


def test_a_noisy_stream_that_is_frozen_to_the_end():
    t_ns, poses = movement(60)
    poses[300:] = poses[300]
    (one,) = found(t_ns, poses, 60)
    assert (one.cause, one.samples.sum()) == ("frozen", len(poses) - 301)
    assert not one.harmless


def test_a_noisy_stream_of_single_floats_that_hardly_turns():
    t_ns, poses = movement(100)
    turned = Rotation.from_rotvec(1e-3 * poses[:, :3]).as_quat()[:, [3, 0, 1, 2]]
    poses = np.concatenate([poses[:, :3], turned], axis=1).astype(np.float32)
    assert found(t_ns, poses, 100) == []
    poses[500:] = poses[500]
    (one,) = found(t_ns, poses, 100)
    assert (one.cause, one.samples.sum()) == ("frozen", len(poses) - 501)


def test_a_noisy_stream_that_goes_on_where_it_was_lost_nothing():
    t_ns, poses = movement(120)
    poses[300:420, :3] = poses[300, :3] + 3e-4 * np.random.default_rng(1).standard_normal((120, 3))
    poses[300:420, 3:] = poses[300, 3:]
    poses[320:400] = poses[320]
    (one,) = (one for one in found(t_ns, poses, 120) if one.cause == "frozen")
    assert one.harmless
    assert np.flatnonzero(one.samples).tolist() == list(range(321, 400))


NOISE_RAD = 5e-4


def noisy(rate_hz, seed=0):
    """The same with noise of the rotation, too."""
    t_ns, poses = movement(rate_hz, seed=seed)
    noise = NOISE_RAD * np.random.default_rng([seed, 1]).standard_normal((len(poses), 3))
    turn = Rotation.from_quat(poses[:, [4, 5, 6, 3]]) * Rotation.from_rotvec(noise)
    poses[:, 3:] = turn.as_quat()[:, [3, 0, 1, 2]]
    return t_ns, poses


@pytest.mark.parametrize("columns", [[2], [0, 1, 2], [3, 4, 5, 6]], ids=["z", "position", "turn"])
@pytest.mark.parametrize("dither", [0.0, 1e-7])
@pytest.mark.parametrize("rate_hz", [100, 250])
def test_a_part_of_noisy_poses_that_stands_still_is_located(rate_hz, columns, dither):
    for seed in range(3):
        t_ns, poses = noisy(rate_hz, seed)
        assert found(t_ns, poses, rate_hz) == []
        half = len(poses) // 2
        ticks = np.random.default_rng(seed).integers(-1, 2, (half, len(columns)))
        poses[half:, columns] = poses[half, columns] + dither * ticks
        frozen = [one.samples for one in found(t_ns, poses, rate_hz) if one.cause == "frozen"]
        # Runs begin and end where neighbours differ.
        assert abs(np.any(frozen, axis=0).sum() - half) <= 3


@pytest.mark.parametrize("lag", [2, 3, 10, 50])
def test_a_buffer_that_comes_again_and_again_is_frozen(lag):
    t_ns, poses = noisy(100)
    poses[200:400] = poses[200 + np.arange(200) % lag]
    (one,) = (one for one in found(t_ns, poses, 100) if one.cause == "frozen")
    assert np.flatnonzero(one.samples).tolist() == list(range(200 + lag, 400))


def test_values_held_for_a_part_of_the_time():
    t_ns, poses = noisy(100)
    at = np.arange(300, 600)
    poses[at] = poses[300 + (at - 300) // 3 * 3]
    (one,) = (one for one in found(t_ns, poses, 100) if one.cause == "repeated")
    assert np.array_equal(np.flatnonzero(one.samples), at[(at - 300) % 3 > 0])
    assert one.factor == 1


def test_a_tracker_that_turns_in_one_place_knows_no_positions():
    t_ns, poses = noisy(100)
    poses[:, :3] *= 1e-3
    whole = [one for one in found(t_ns, poses, 100) if one.whole]
    assert [one.cause for one in whole] == ["frozen"]


@pytest.mark.parametrize(("rate_hz", "leap_m"), [(30, 0.12), (60, 0.06), (100, 0.03), (250, 0.02)])
def test_small_leaps_of_a_trackers_world_are_found(rate_hz, leap_m):
    for seed in range(5):
        t_ns, poses = noisy(rate_hz, seed)
        period_ns = round(1e9 / rate_hz)
        assert lasting_jumps(t_ns, poses, period_ns=period_ns).tolist() == []
        poses[200:, 1] += leap_m
        assert lasting_jumps(t_ns, poses, period_ns=period_ns).tolist() == [200]


def test_noise_that_rises_and_quick_motion_are_no_standstill():
    t_ns, poses = noisy(100)
    poses[400:, :3] += 0.01 * np.random.default_rng(3).standard_normal((len(poses) - 400, 3))
    assert [one.cause for one in found(t_ns, poses, 100) if one.cause == "frozen"] == []
    # 3 m/s and 40 m/s², to and fro.
    t_ns, poses = noisy(100)
    poses[:, 0] += 3**2 / 40 * np.sin(40 / 3 * t_ns / 1e9)
    assert found(t_ns, poses, 100) == []
    assert len(lasting_jumps(t_ns, poses, period_ns=10**7)) == 0


def test_nodes_of_a_hand_that_stand_still_are_named():
    rng = np.random.default_rng(0)
    waves = gaussian_filter1d(rng.standard_normal((900, 25, 3)), 40, axis=0)
    keypoints = 0.02 * waves / waves.std() + 4e-4 * rng.standard_normal(waves.shape)
    descriptor = StreamDescriptor(
        name="keypoints_left", kind="keypoints", shape=(25, 3), dtype="float32", unit="m",
        nominal_rate_hz=120,
    )  # fmt: skip
    t_ns = np.rint(np.arange(900) * 1e9 / 120).astype(np.int64)
    assert implausible_values(descriptor, t_ns, keypoints) == []
    keypoints[300:, 9] = keypoints[300, 9] + 1e-7 * rng.standard_normal((600, 3))
    (one,) = implausible_values(descriptor, t_ns, keypoints)
    assert "index" in one.message
    assert np.flatnonzero(one.nodes.any(axis=0)).tolist() == [9]
    assert abs(one.nodes[:, 9].sum() - 599) <= 1


@pytest.mark.parametrize("times", [2, 3, 4])
def test_values_that_come_several_times(times):
    t_ns, poses = movement(120)
    poses = poses[np.arange(len(poses)) // times * times]
    (one,) = found(t_ns, poses, 120)
    assert (one.cause, one.factor) == ("repeated", times)
    assert np.array_equal(~one.samples, np.arange(len(poses)) % times == 0)


def hands():
    both = [RobotHand(side) for side in ("left", "right")]
    return (
        np.concatenate([hand.lower_rad for hand in both]),
        np.concatenate([hand.upper_rad for hand in both]),
    )


def test_joints_in_degrees_beyond_their_limits_and_within_them():
    lower, upper = hands()
    share = gaussian_filter1d(np.random.default_rng(0).random((600, 40)), 20, axis=0)
    joints = lower + (upper - lower) * share
    assert implausible_joints(joints, lower, upper) == []
    # Real hands go a little beyond.
    assert implausible_joints(joints + 0.3 * (upper - lower) / 3, lower, upper) == []
    (degrees,) = implausible_joints(np.degrees(joints), lower, upper)
    assert (degrees.cause, degrees.whole) == ("unit", True)
    assert "these look like degrees" in degrees.message
    other = joints.copy()
    other[:, 3] += 3
    (limits,) = implausible_joints(other, lower, upper)
    assert (limits.cause, limits.whole) == ("limits", True)
    assert "joint 3 " in limits.message
    joints[200, 7] = 9
    (once,) = implausible_joints(joints, lower, upper)
    assert (once.cause, once.whole, np.flatnonzero(once.samples).tolist()) == (
        "limits",
        False,
        [200],
    )


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_joints_are_in_radians_whatever_their_unit_says(unit):
    lower, upper = hands()
    share = gaussian_filter1d(np.random.default_rng(0).random((600, 40)), 20, axis=0)
    about = StreamDescriptor(
        name="joints_measured", kind="robot_state", shape=(40,), dtype="float64", unit=unit,
        nominal_rate_hz=100,
    )  # fmt: skip
    joints, t_ns = lower + (upper - lower) * share, np.arange(600) * 10_000_000
    (degrees,) = implausible_values(about, t_ns, np.degrees(joints), of_robot=True)
    assert (degrees.cause, degrees.whole) == ("unit", True)
    # Such as their currents.
    other = about.model_copy(update={"name": "currents", "unit": "A"})
    assert implausible_values(other, t_ns, np.degrees(joints), of_robot=True) == []


def test_commands_may_press_beyond_limits_but_are_in_radians():
    lower, upper = hands()
    joints = np.tile((lower + upper) / 2, (600, 1))
    joints[:, 20] = upper[20] + 0.4
    descriptor = StreamDescriptor(
        name="joints_commanded", kind="robot_state", shape=(40,), dtype="float64", unit="rad",
        nominal_rate_hz=100,
    )  # fmt: skip
    t_ns = np.arange(600, dtype=np.int64) * 10**7
    assert implausible_values(descriptor, t_ns, joints) == []
    measured = descriptor.model_copy(update={"name": "joints_measured"})
    assert [one.cause for one in implausible_values(measured, t_ns, joints)] == ["limits"]
    moved = np.degrees(joints + 0.1 * np.sin(t_ns / 1e9)[:, None])
    assert [one.cause for one in implausible_values(descriptor, t_ns, moved)] == ["unit"]


@pytest.mark.skipif(not HANDS.is_file(), reason="no recordings in ../shared/data")
def test_a_real_hand_is_not_frozen_until_it_is():
    real = np.load(HANDS)
    assert list(implausible_repeats(real)) == []
    for nodes in (slice(5, 9), slice(1, 5)):
        assert list(implausible_repeats(real[:, nodes])) == []
    index = real[:, 5:9].copy()
    index[100:160] = index[100]
    (one,) = implausible_repeats(index)
    assert (one.cause, np.flatnonzero(one.samples).tolist()) == ("frozen", list(range(101, 160)))
    (thrice,) = implausible_repeats(real[np.arange(309) // 3 * 3])
    assert thrice.factor == 3


@pytest.mark.parametrize(
    "change",
    [
        {(0, 2): 700.0},
        {(0, 0): 250.0, (1, 1): 250.0, (0, 2): 160.0, (1, 2): 120.0},
        {(1, 2): -3.0},
        {(0, 0): 5.0},
        {(0, 0): 1500.0},
        {(2, 2): 0.0},
        {(0, 0): 1e9},
    ],
    ids=["right of it", "of half the size", "above it", "short", "unequal", "form", "long"],
)
def test_camera_matrices_that_no_lens_has(change):
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    check_camera_matrix(K, (640, 480), where="K_head")
    for place, value in change.items():
        K[place] = value
    with pytest.raises(InvalidInputError, match="K_head: got focal lengths") as refused:
        check_camera_matrix(K, (640, 480), where="K_head")
    assert refused.value.details["fault"] == "camera_matrix"


def first_order(rate_hz, tau_s, rest_s=3.0):
    """Joints that move, rest exactly for a while, and close as a first-order lag."""
    lower, upper = hands()
    t_s = np.arange(round(12 * rate_hz)) / rate_hz
    middle = (lower + upper) / 2
    way = 0.2 * np.sin(t_s * 1.3).clip(-1, 0.9)
    # Rests where it came to a stand, then goes to another place.
    start = round(4 * rate_hz)
    stop = start + round(rest_s * rate_hz)
    way[:start] = 0.2 * np.sin(np.pi * t_s[:start] / 8)
    way[start:stop] = way[start - 1]
    way[stop:] = 0.2 - 0.4 * (1 - np.exp(-(t_s[stop:] - t_s[stop - 1]) / tau_s))
    return middle + way[:, None] * (upper - lower) / 2


@pytest.mark.parametrize("rate_hz", [20, 30, 60, 100])
@pytest.mark.parametrize("tau_s", [0.02, 0.05, 0.1])
def test_a_robot_that_rests_and_closes_at_once_was_not_frozen(rate_hz, tau_s):
    lower, upper = hands()
    assert implausible_joints(first_order(rate_hz, tau_s), lower, upper) == []


def test_samples_lost_at_the_end_of_a_rest_are_no_leap():
    t_ns, poses = movement(100, noise_m=0.0, rests=True)
    still = (poses[1:] == poses[:-1]).all(axis=1)
    last = np.flatnonzero(still)[-1]
    for lost in ([], range(last - 2, last + 60)):
        kept = np.delete(np.arange(len(poses)), lost)
        period_ns = 10_000_000
        assert implausible_poses(t_ns[kept], poses[kept], period_ns=period_ns, can_rest=True) == []
    poses[last - 2 : last + 60] = np.nan
    assert found(t_ns, poses, 100) == []


@pytest.mark.parametrize(
    ("held_hz", "rate_hz"), [(15, 120), (15, 100), (24, 100), (25, 120), (22, 100), (40, 60)]
)
@pytest.mark.parametrize("noise_m", [0.0, 0.0005])
def test_any_rate_may_be_held_at_any_other(held_hz, rate_hz, noise_m):
    t_ns, poses = movement(rate_hz, noise_m=noise_m)
    held = poses[np.floor(np.arange(len(poses)) * held_hz / rate_hz + 1e-9).astype(int)]
    (one,) = found(t_ns, held, rate_hz)
    assert (one.cause, round(one.factor, 1)) == ("repeated", round(rate_hz / held_hz, 1))
    changed = np.concatenate([[True], (held[1:] != held[:-1]).any(axis=1)])
    assert np.array_equal(~one.samples, changed)


def test_a_held_stream_may_rest_as_well():
    t_ns, poses = movement(50, noise_m=0.0, rests=True)
    held, held_ns = np.repeat(poses, 2, axis=0), np.arange(2 * len(t_ns)) * 10_000_000
    (one,) = implausible_poses(held_ns, held, period_ns=10_000_000, can_rest=True)
    assert (one.cause, one.factor) == ("repeated", 2)
    # Half of the rest remains, as of all else.
    assert abs(one.samples.mean() - 0.5) < 0.01


@pytest.mark.parametrize("rate_hz", [60, 120, 250])
@pytest.mark.parametrize("speed_m_s", [2, 5])
def test_a_hand_that_hits_the_table_is_plausible(rate_hz, speed_m_s):
    t_s = np.arange(3 * rate_hz) / rate_hz
    poses = np.zeros((len(t_s), 7))
    poses[:, 3] = 1
    poses[:, 2] = np.interp(t_s, [0, 1, 1 + 0.3 / speed_m_s, 3], [0.3, 0.3, 0.0, 0.0])
    poses[:, :3] += 5e-4 * np.random.default_rng(0).standard_normal((len(t_s), 3))
    assert found(np.rint(t_s * 1e9).astype(np.int64), poses, rate_hz) == []


def test_two_worlds_of_a_tracker_are_no_outliers():
    t_ns, poses = movement(60)
    poses[200:, 0] += 0.6
    poses[212:, 1] += 0.6
    assert found(t_ns, poses, 60) == []
    assert lasting_jumps(t_ns, poses, period_ns=round(1e9 / 60)).tolist() == [200, 212]


@pytest.mark.parametrize("rate_hz", [30, 60, 120])
@pytest.mark.parametrize("step_m", [0.0001, 0.001, 0.002])
@pytest.mark.parametrize("step_rad", [0.0, np.radians(0.1)])
@pytest.mark.parametrize("noise_m", [0.00005, 0.0005])
def test_rounded_poses_may_rest_and_move_slowly(rate_hz, step_m, step_rad, noise_m):
    for seed in range(3):
        for rests, slower in ((True, 1.0), (False, 0.1)):
            t_ns, poses = movement(rate_hz, seed=seed, noise_m=noise_m, rests=rests)
            poses[:, :3] = np.round(slower * poses[:, :3] / step_m) * step_m
            if step_rad:
                turns_rad = Rotation.from_quat(poses[:, [4, 5, 6, 3]]).as_rotvec() * slower
                turns = Rotation.from_rotvec(np.round(turns_rad / step_rad) * step_rad)
                poses[:, 3:] = turns.as_quat()[:, [3, 0, 1, 2]]
            # As they are stored.
            assert found(t_ns, poses.astype(np.float32), rate_hz) == []


@pytest.mark.parametrize("shape", [(0, 7), (1, 7), (2, 7)])
def test_few_samples_say_nothing(shape):
    assert found(np.arange(shape[0], dtype=np.int64) * 10**7, np.ones(shape) / 2, 100) == []
    assert list(implausible_repeats(np.ones(shape))) == []
