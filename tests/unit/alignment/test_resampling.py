"""Values on a common grid: hand-made lines, their ends and gaps; joints that stay in limits."""

import numpy as np
import pytest

from benchmarks.simulated.hand_motions import motion_of
from dextouch.streams import StreamDescriptor
from services.alignment.retargeting import RetargetStatus
from services.alignment.synchronization.grid_actions import (
    GriddedStreams,
    place_streams,
    retarget_hands,
    status_on_grid,
)
from services.alignment.synchronization.recorded_streams import LoadedStream
from services.alignment.synchronization.resampling import (
    longest_run,
    place_on_grid,
    poses_on_grid,
    vectors_on_grid,
)
from services.twin.hands import twin_hand

MS = 1_000_000


def placed(t_ms, grid_ms, max_gap_ms=30):
    return place_on_grid(
        np.array(t_ms) * MS,
        np.array(grid_ms) * MS,
        period_ns=10 * MS,
        max_gap_ns=max_gap_ms * MS,
    )


def test_a_stream_goes_on_for_one_and_a_half_periods_at_its_ends():
    grid_ms = [-100, -16, -15, -1, 0, 4, 10, 20, 35, 36, 10_000]
    at = placed([0, 10, 20], grid_ms)
    assert at.valid.tolist() == [False, False, *[True] * 7, False, False]
    # A value that rises by 2 a millisecond.
    values = vectors_on_grid(np.array([[0.0], [20.0], [40.0]]), at)[:, 0]
    np.testing.assert_allclose(values[at.valid], [-30, -2, 0, 8, 20, 40, 70], atol=1e-9)


@pytest.mark.parametrize("times_ms", [[0, 10, 20, 20.01], [0, 0.01, 10, 20]])
def test_samples_that_came_in_a_burst_lead_nowhere_far_at_the_ends(times_ms):
    """1 mm within 10 µs is no speed: beyond the ends at most as in half a period."""
    t_ns = (np.array(times_ms) * MS).astype(np.int64)
    grid_ns = np.array([t_ns[0] - 15 * MS, t_ns[-1] + 15 * MS])
    at = place_on_grid(t_ns, grid_ns, period_ns=10 * MS, max_gap_ns=30 * MS)
    assert at.valid.all()
    values = vectors_on_grid(np.array([[0.0], [1.0], [2.0], [3.0]]), at)[:, 0]
    before, after = (1.5, 3.0) if times_ms[-1] > 20 else (3.0, 1.5)
    np.testing.assert_allclose(values, [-before, 3 + after], atol=1e-9)


def test_a_stream_that_is_faster_than_declared_goes_on_along_its_line():
    """Declared 30 Hz, sent each 11 ms, 16 ms beyond the end: 1 + 16 / 11 spans."""
    t_ns = np.arange(10) * 11 * MS
    at = place_on_grid(
        t_ns, t_ns[-1:] + 16 * MS, period_ns=round(1e9 / 30), max_gap_ns=round(2.5e9 / 30)
    )
    assert at.valid.all()
    np.testing.assert_allclose(at.weight, [1 + 16 / 11], atol=1e-12)


def test_a_pose_between_two_samples_has_its_share_of_both():
    """From 0 to 1 m and from 0 to 80 degrees about z, at a quarter and at three quarters."""
    half_rad = np.deg2rad(40)
    poses = np.array(
        [[0.0, 0, 0, 1, 0, 0, 0], [1.0, 0, 0, np.cos(half_rad), 0, 0, np.sin(half_rad)]]
    )
    Ts = poses_on_grid(poses, placed([0, 20], [5, 15]))
    np.testing.assert_allclose(Ts[:, :3, 3], [[0.25, 0, 0], [0.75, 0, 0]], atol=1e-12)
    turned_deg = np.rad2deg(np.arctan2(Ts[:, 1, 0], Ts[:, 0, 0]))
    np.testing.assert_allclose(turned_deg, [20, 60], atol=1e-9)


@pytest.mark.parametrize(
    ("valid", "expected"),
    [("..xxx.x", (2, 5)), ("x.xx..xx", (2, 4)), ("xxxx", (0, 4)), ("....", (0, 0)), ("", (0, 0))],
)
def test_an_episode_is_the_longest_run(valid, expected):
    """The first one of equal length."""
    assert longest_run(np.array([step == "x" for step in valid], dtype=bool)) == expected


def test_no_line_is_drawn_through_a_gap():
    # 100 ms without a sample behind the first and before the last.
    at = placed([0, 100, 110, 210], [-5, 0, 5, 50, 99, 100, 105, 110, 115, 205, 215])
    assert np.flatnonzero(at.valid).tolist() == [1, 5, 6, 7]


def test_a_step_is_as_good_as_the_worse_of_its_samples():
    status = np.array([RetargetStatus.SOLVED, RetargetStatus.MISSING, RetargetStatus.PARTIAL])
    at = placed([0, 10, 20], [0, 5, 10, 12, 20])
    names = [RetargetStatus(value).name for value in status_on_grid(status, at)]
    assert names == ["SOLVED", "MISSING", "MISSING", "MISSING", "PARTIAL"]


@pytest.mark.parametrize("end", ["first", "last"])
def test_joints_beyond_the_last_sample_stay_in_their_limits(end):
    """The line through the last two samples would leave the limits that the last one lies at."""
    streams, at, upper_rad = {}, {}, {}
    # At 60 Hz; grid steps one period beyond either end.
    t_ns = np.rint(np.arange(40) * (1e9 / 60)).astype(np.int64)
    grid_ns = np.array([t_ns[0] - 16 * MS, t_ns[20], t_ns[-1] + 16 * MS])
    for side in ("left", "right"):
        hand = twin_hand(side, "robot")
        upper_rad[side] = hand.kinematics.upper_rad
        joints = np.full((40, 20), 0.3)
        # PIPs of the four fingers close by 0.12 rad a sample, at last to 0.06 rad beyond the limit.
        closing = upper_rad[side][6] + 0.06 - 0.12 * np.arange(40)[::-1]
        joints[:, 6::4] = np.maximum(closing, 0.3)[:, None]
        samples = joints if end == "last" else joints[::-1]
        name = f"keypoints_{side}"
        streams[name] = LoadedStream(
            StreamDescriptor(
                name=name,
                kind="keypoints",
                shape=(25, 3),
                dtype="float64",
                unit="m",
                nominal_rate_hz=60.0,
                side=side,
            ),
            t_ns,
            motion_of(hand, samples).keypoints_m,
        )
        at[name] = place_on_grid(t_ns, grid_ns, period_ns=16_666_667, max_gap_ns=50 * MS)
        assert at[name].valid.all()
    hands = retarget_hands(GriddedStreams(grid_ns, streams, at), {})
    found = np.stack([hands[side].joints_rad for side in ("left", "right")], axis=1)
    row = 2 if end == "last" else 0
    for side_index, side in enumerate(("left", "right")):
        assert (found[:, side_index] <= upper_rad[side]).all()
        np.testing.assert_array_equal(found[row, side_index, 6::4], upper_rad[side][6::4])
        assert (found[1, side_index, 6::4] < 0.6).all()


@pytest.mark.parametrize(("max_gap_ms", "is_bridged"), [(50, False), (333, True), (1000, True)])
def test_forces_of_pads_are_known_across_the_gaps_that_are_bridged(max_gap_ms, is_bridged):
    period_ns = 16_666_667
    t_ns = period_ns * np.arange(120, dtype=np.int64)
    # 317 ms between neighbours, and one pad whose gap is of a single sample.
    t_ns = np.delete(t_ns, slice(50, 68))
    forces_n = np.full((len(t_ns), 6), 5.0)
    forces_n[20, 3] = np.nan
    stream = LoadedStream(
        StreamDescriptor(
            name="tactile_left",
            kind="tactile",
            shape=(320,),
            dtype="float32",
            unit="kPa",
            nominal_rate_hz=60.0,
            side="left",
        ),
        t_ns,
        forces_n,
    )
    grid_ns = np.arange(0, t_ns[-1], 66 * MS)
    gridded = place_streams({"tactile_left": stream}, grid_ns, max_gap_ns=max_gap_ms * MS)
    felt_n = gridded.pad_forces_n("left")
    in_gap = (grid_ns > t_ns[49]) & (grid_ns < t_ns[50])
    np.testing.assert_allclose(felt_n[~in_gap], 5.0)
    np.testing.assert_allclose(felt_n[in_gap], 5.0 if is_bridged else 0.0)
    np.testing.assert_array_equal(gridded.pad_forces_n("right"), 0.0)
