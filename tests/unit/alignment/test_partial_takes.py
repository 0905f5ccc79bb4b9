"""Takes with what there is: one hand, no head pose, no camera matrix, fingers that are not seen."""

import numpy as np
import pytest

from dextouch.episodes import (
    EpisodeGrid,
    EpisodeStore,
    decode_window,
    encode_window,
    interpolated_actions,
    measured_taxels,
    needs,
    select_episodes,
)
from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.hands import chain_indices
from dextouch.hands.actions import IDENTITY_POSE_9D
from dextouch.schemas import RecordingAttributes
from dextouch.streams import StreamDescriptor
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentOptions
from services.twin.hands import HumanHand
from tests.unit.alignment import recordings

SECONDS = 6.0
RATE_HZ = 60.0
POSES = ("wrist_left", "wrist_right", "head")
HANDS = ("keypoints_left", "keypoints_right")
FINGERS = ("thumb", "index", "middle", "ring", "little")
# Columns of the action by part, from equation 5 of the paper: wrists, joints, head.
COLUMNS = {"wrist_left": (0, 9), "wrist_right": (9, 18), "head": (58, 67),
           "keypoints_left": (18, 38), "keypoints_right": (38, 58)}  # fmt: skip


def keypoints(side, t_s):
    hand = HumanHand(side)
    middle = (hand.lower_rad + hand.upper_rad) / 2
    phase = np.arange(20) / 3
    reach = 0.3 * (hand.upper_rad - hand.lower_rad)
    return hand.keypoints_m(middle + reach * np.sin(1.5 * t_s[:, None] + phase))


def write_person(store, *, streams=POSES + HANDS, edit=lambda name, values: values, **calibration):
    """A person who stands still and moves the fingers."""
    attributes = RecordingAttributes(
        recording_id="take",
        task="wave",
        instruction="Wave.",
        domain="human",
        station="test",
        started_t_host_ns=recordings.START_NS,
        calibration={"K_head": recordings.K_HEAD} if calibration.get("K_head", True) else {},
    )
    t_ns = np.rint(np.arange(round(SECONDS * RATE_HZ)) * 1e9 / RATE_HZ).astype(np.int64)
    with store.writer(kind="recording", attributes=attributes) as writer:
        for name in streams:
            is_hand = name in HANDS
            side = name.split("_")[1] if is_hand else None
            values = (
                keypoints(side, t_ns / 1e9) if is_hand else np.tile(recordings.POSE, (len(t_ns), 1))
            )
            writer.add_stream(
                StreamDescriptor(
                    name=name,
                    kind="keypoints" if is_hand else "pose",
                    shape=values.shape[1:],
                    dtype="float64",
                    unit="m" if is_hand else "pose_m_wxyz",
                    nominal_rate_hz=RATE_HZ,
                    side=side,
                )
            )
            stamps = {"t_host_ns": t_ns + recordings.START_NS, "t_device_ns": t_ns + 9 * 10**11}
            writer.append(name, values=edit(name, values), **stamps)


def aligned(folder, **take):
    store = EpisodeStore(folder)
    write_person(store, **take)
    report = align_recording(store, "take", AlignmentOptions())
    return store, EpisodeGrid(store.open(report.episode_id))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return aligned(tmp_path_factory.mktemp("whole"))[1]


@pytest.mark.parametrize(
    "missing",
    [
        ("wrist_left", "keypoints_left"),
        ("keypoints_right",),
        ("head",),
        ("wrist_right", "keypoints_right", "head"),
        POSES,
    ],
    ids=" and ".join,
)
def test_an_episode_has_what_the_take_has(tmp_path, whole, missing):
    kept = tuple(name for name in POSES + HANDS if name not in missing)
    _, grid = aligned(tmp_path, streams=kept)
    assert set(grid.about.absent) == set(missing)
    is_there = np.ones(67, dtype=bool)
    for name in missing:
        is_there[slice(*COLUMNS[name])] = False
    np.testing.assert_array_equal(grid.measured_columns, np.tile(is_there, (len(grid), 1)))
    # What is there is what it is in a take of everything.
    np.testing.assert_allclose(grid.measured[:, is_there], whole.measured[:, is_there], atol=1e-12)
    for name in missing:
        part = grid.measured[:, slice(*COLUMNS[name])]
        rest = np.zeros(20) if name in HANDS else IDENTITY_POSE_9D
        np.testing.assert_array_equal(part, np.tile(rest, (len(grid), 1)))


def test_a_robot_may_have_one_wrist(tmp_path):
    store = EpisodeStore(tmp_path)
    recordings.write_recording(store, "take", streams=("wrist_right", "joints_measured"))
    report = align_recording(store, "take", AlignmentOptions())
    grid = EpisodeGrid(store.open(report.episode_id))
    assert set(grid.about.absent) == {"wrist_left", "head"}
    assert {"wrist_left", "head"} <= set(report.absent)
    np.testing.assert_allclose(grid.measured[:, 18:58], 0.25)


def test_a_take_without_any_hand_is_refused_by_what_it_lacks(tmp_path):
    with pytest.raises(InvalidInputError, match=r"'wrist_left'.*'keypoints_right'.*at least"):
        aligned(tmp_path, streams=("head",))


def test_joints_of_another_robot_are_refused_by_their_number(tmp_path):
    store = EpisodeStore(tmp_path)
    recordings.write_recording(store, "take", num_joints=41)
    with pytest.raises(InvalidInputError, match=r"'joints_measured' .* \(41,\), expected the 40"):
        align_recording(store, "take", AlignmentOptions())


def test_a_camera_without_a_matrix(tmp_path):
    store, grid = aligned(tmp_path, K_head=False)
    assert grid.about.K_head is None
    assert grid.about.absent == ()
    with pytest.raises(InvalidInputError, match="station calibrate camera"):
        grid.about.K_head_matrix()
    window = grid.reader.window(3, 5, cameras=())
    assert window.K_head is None
    assert decode_window(encode_window(window), max_bytes=1 << 20).K_head is None
    with pytest.raises(NotFoundError, match="matrix of the head camera"):
        list(select_episodes([store], needs=[needs.EVERY_PART]))
    assert len(list(select_episodes([store]))) == 1


def lost_fingers(lost):
    """`lost` are side, finger, first and last sample (exclusive)."""

    def edit(name, values):
        for side, finger, first, last in lost:
            if name == f"keypoints_{side}":
                values[first:last, chain_indices(FINGERS[finger])] = np.nan
        return values

    return edit


def test_fingers_that_are_not_seen_are_marked_as_they_were_lost(tmp_path, whole):
    lost = [("left", 0, 90, 120), ("left", 0, 200, 206), ("right", 3, 100, 220)]
    _, grid = aligned(tmp_path, edit=lost_fingers(lost))
    expected = np.ones((len(grid), 67), dtype=bool)
    for side, finger, first, last in lost:
        # From the last sample that shows it to the first one that does again.
        inside = (grid.t_ref_ns / 1e9 > (first - 1) / RATE_HZ + 1e-9) & (
            grid.t_ref_ns / 1e9 < last / RATE_HZ - 1e-9
        )
        column = COLUMNS[f"keypoints_{side}"][0] + 4 * finger
        expected[inside, column : column + 4] = False
    np.testing.assert_array_equal(grid.measured_columns, expected)
    np.testing.assert_array_equal(grid.interpolated, ~expected.all(axis=1))
    # All other joints are as if nothing had been lost, and the lost ones lead from end to end.
    off_rad = np.abs(grid.measured - whole.measured)
    assert off_rad[expected].max() < 0.02
    assert grid.measured_columns.mean() > 0.9
    window = grid.reader.window(0, len(grid), cameras=())
    np.testing.assert_array_equal(window.actions_measured, expected)
    again = decode_window(encode_window(window), max_bytes=1 << 24)
    np.testing.assert_array_equal(again.actions_measured, expected)


def test_a_single_sample_without_a_finger_is_no_gap(tmp_path):
    _, grid = aligned(tmp_path, edit=lost_fingers([("left", 1, 50, 51), ("right", 4, 300, 301)]))
    assert grid.measured_columns.all()


def test_a_finger_that_is_never_seen_is_absent(tmp_path, whole):
    _, grid = aligned(tmp_path, edit=lost_fingers([("right", 3, 0, 10_000)]))
    assert grid.about.absent == ("ring_right",)
    assert not grid.interpolated.any()
    expected = np.ones(67, dtype=bool)
    expected[50:54] = False
    np.testing.assert_array_equal(grid.measured_columns, np.tile(expected, (len(grid), 1)))
    assert np.abs(grid.measured[:, 50:54]).max() == 0
    assert np.abs(grid.measured - whole.measured)[:, expected].max() < 0.02


def test_rows_are_half_open_on_the_clock_of_the_episode():
    t_ns = np.rint(np.arange(6) * 1e9 / 15).astype(np.int64)
    rows = {
        "interpolated_head_s": ((t_ns[1] / 1e9, t_ns[3] / 1e9),),
        "interpolated_fingers_right_s": ((t_ns[4] / 1e9, t_ns[5] / 1e9, 4.0),),
        "K_head": ((0.0, 1.0),),
    }
    found = interpolated_actions(rows, t_ns)
    assert found[:, 58:].all(axis=1).tolist() == [False, True, True, False, False, False]
    assert np.argwhere(found[:, :58]).tolist() == [[4, column] for column in range(54, 58)]


def test_refused_taxels_are_not_measured():
    states = np.zeros(320)
    states[[5, 300]] = 2, 7
    found = measured_taxels({"tactile_right_refused_taxels": (tuple(states),)})
    assert found[0].all()
    assert np.flatnonzero(~found[1]).tolist() == [5, 300]


COMMANDED = ("joints_commanded", "wrist_left_commanded", "wrist_right_commanded")


def robot(folder, streams, *, lost=()):
    """A robot whose commands are recorded beside what it did; all stand still."""
    store = EpisodeStore(folder)
    recordings.write_recording(store, "take", streams=streams, seconds=6.0, lost=lost)
    report = align_recording(store, "take", AlignmentOptions())
    return report, EpisodeGrid(store.open(report.episode_id))


def test_gaps_of_commands_and_of_measurements_are_told_apart(tmp_path):
    names = ("wrist_left", "wrist_right", "head", "joints_measured", *COMMANDED)
    lost = [("wrist_left_commanded", 200, 220), ("wrist_right", 400, 420)]
    _, grid = robot(tmp_path, names, lost=lost)
    windows = {
        kind: grid.reader.window(0, len(grid), cameras=(), action_kind=kind).actions_measured
        for kind in ("measured", "commanded")
    }
    unmeasured = {kind: np.unique(np.nonzero(~one)[1]).tolist() for kind, one in windows.items()}
    assert unmeasured == {"measured": list(range(9, 18)), "commanded": list(range(9))}
    assert grid.interpolated.sum() == sum((~one).any(axis=1).sum() for one in windows.values())


def test_an_arm_alone_has_its_commands(tmp_path):
    names = ("wrist_right", "head", "joints_measured", "joints_commanded", "wrist_right_commanded")
    _, grid = robot(tmp_path, names)
    assert grid.action_kind == "commanded"
    window = grid.reader.window(0, len(grid), cameras=(), action_kind="commanded")
    expected = np.ones(67, dtype=bool)
    expected[:9] = False
    np.testing.assert_array_equal(window.actions_measured, np.tile(expected, (len(grid), 1)))


def test_commands_that_make_no_action_cut_nothing(tmp_path):
    names = ("wrist_left", "wrist_right", "head", "joints_measured", "wrist_left_commanded")
    _, grid = robot(tmp_path, names, lost=[("wrist_left_commanded", 150, 600)])
    assert grid.action_kind == "measured"
    assert grid.measured_columns.all()
    assert len(grid) >= 88


def test_a_stream_with_a_sample_or_a_hand_that_is_never_seen_is_absent(tmp_path, whole):
    def unseen(name, values):
        return np.full_like(values, np.nan) if name == "keypoints_left" else values

    _, grid = aligned(tmp_path / "hand", edit=unseen)
    assert grid.about.absent == ("keypoints_left",)
    assert len(grid) == len(whole)
    store = EpisodeStore(tmp_path / "head")
    lost = [("head", 1, 600)]
    recordings.write_recording(store, "take", seconds=6.0, lost=lost)
    grid = EpisodeGrid(store.open(align_recording(store, "take", AlignmentOptions()).episode_id))
    assert grid.about.absent == ("head",)
    assert len(grid) >= 88


def test_figures_are_of_what_is_there(tmp_path):
    report = EpisodeStore(tmp_path)
    write_person(report, streams=("keypoints_right", "wrist_right"))
    quality = align_recording(report, "take", AlignmentOptions()).quality
    assert "wrist_right_peak_speed_m_s" in quality
    assert not [name for name in quality if name.startswith(("wrist_left", "retargeting_left"))]


def test_steps_without_a_finger_are_counted(tmp_path):
    _, grid = aligned(tmp_path, edit=lost_fingers([("left", 0, 90, 120)]))
    assert grid.about.quality["num_steps_interpolated"] == grid.interpolated.sum() > 5


def test_a_finger_that_is_seen_once_is_at_rest(tmp_path):
    _, grid = aligned(tmp_path, edit=lost_fingers([("left", 0, 0, 40), ("left", 0, 41, 10_000)]))
    assert grid.about.absent == ("thumb_left",)
    assert np.abs(grid.measured[:, 18:22]).max() == 0
