"""One judge at a time, on made-up blocks: what is found, and what is not."""

import numpy as np
import pytest

from dextouch.streams import Sample, StreamDescriptor
from dextouch.tactile.layout import DEXTOUCH_V1, expand_taxels
from services.acquisition.clock import VirtualClock
from services.acquisition.devices.pose_tracker import PoseTrackerDecoder, pose_descriptor
from services.acquisition.drivers.base import Driver
from services.acquisition.drivers.images import ImageQuality
from services.acquisition.health.cells import TaxelCheck, count_taxels, neighbour_share
from services.acquisition.health.glove_records import GloveRecord
from services.acquisition.health.streams import (
    BodiesCheck,
    CameraCheck,
    FiniteCheck,
    PlausibilityCheck,
    PoseCheck,
    SampleQueue,
    TrackingCheck,
)
from services.acquisition.mocks.ports import HidPort
from services.acquisition.supervisor import StreamCounters
from tests.unit.acquisition.health_blocks_made import SECOND_NS, block, codes, judged
from tests.unit.streams.test_bodies import person

TARE, GAIN = 120.0, 40.0


class Hand:
    """A left glove whose palm and tips are pressed by a bump that wanders over them."""

    def __init__(self, *, drift_counts=0.0, pressed=True, tare=TARE):
        full = np.full(360, 1.0)
        cells = DEXTOUCH_V1.raw_indices(side="left")
        self.judge = TaxelCheck(GloveRecord(full * tare, full * GAIN, full * 0.0, cells))
        self.drift_counts, self.pressed = drift_counts, pressed
        self.tare = tare
        self.second = 0

    def __call__(self, change=None):
        t_s = self.second + np.arange(1, 61) / 60
        self.second += 1
        places = np.arange(320)
        wave = np.sin(2 * np.pi * t_s[:, None] + 0.4 * (places // 16) + 0.3 * (places % 16))
        kpa = 15 * (1 + wave) if self.pressed else 0 * wave
        taxels = np.rint(self.tare + self.drift_counts + GAIN * kpa)
        if change is not None:
            change(taxels)
        raw = expand_taxels(taxels, side="left").astype(np.uint16)
        return judged(self.judge, block(t_s, raw), round(self.second * 1e9))


def test_a_healthy_hand_raises_nothing_whether_it_touches_or_rests():
    for pressed in (True, False):
        hand = Hand(pressed=pressed)
        for _ in range(12):
            assert hand().findings == []


@pytest.mark.parametrize(
    ("value", "code"),
    [(TARE, "taxels_dead"), (0, "taxels_dead"), (900, "taxels_stuck"), (65535, "taxels_saturated")],
)
def test_a_taxel_that_does_not_follow_its_neighbours_is_named(value, code):
    def change(taxels):
        taxels[:, 200] = value

    hand = Hand()
    hand()
    hand(change)
    assert codes(hand(change)) == {code: "WARN"}
    for _ in range(3):
        hand()
    assert hand().findings == []


def test_random_copied_and_frozen_readings_of_a_noisy_glove_are_named():
    rng = np.random.default_rng(0)
    hand, last = Hand(pressed=False), np.zeros((60, 320))

    def change(taxels, kind):
        taxels += np.rint(2 * rng.standard_normal(taxels.shape))
        if kind == "random":
            taxels[:, 40:44] = rng.integers(0, 4000, (60, 4))
        if kind == "copied":
            taxels[:, 40] = taxels[:, 90]
        if kind == "frozen":
            taxels[:] = last[0]
        last[:] = taxels

    def told(kind, seconds=12):
        found = {}
        for _ in range(seconds):
            found |= {f.code: f.message for f in hand(lambda taxels: change(taxels, kind)).findings}
        return found

    assert told("") == {}
    assert told("random")["implausible"] == "4 taxels are random"
    told("")
    assert told("copied")["implausible"] == "2 taxels are copied"
    told("")
    # Half of the part of 5 s in which it begins.
    told("", seconds=2)
    assert "frozen" in told("frozen")


def test_head_and_wrists_that_are_not_of_one_person_are_named_live():
    poses = person()
    t_s = np.arange(600) / 100
    for change, named in (({}, None), ({"wrist_left": 39.37}, "wrist_left")):
        check, found = BodiesCheck({}), {}
        for name, of in poses.items():
            scale = [change.get(name, 1)] * 3 + [1] * 4
            for start in range(0, 600, 100):
                part = slice(start, start + 100)
                sent = block(t_s[part], of[part] * scale)
                found[name] = judged(check.of(name), sent, round(t_s[part][-1] * 1e9)).findings
        # Once more, when all are known.
        for name in poses:
            found[name] += judged(
                check.of(name), block(t_s[:0], poses[name][:0]), 6 * 10**9
            ).findings
        assert {name for name, some in found.items() if some} == ({named} if named else set())


def test_five_per_cent_a_whole_pad_or_a_whole_line_is_an_error():
    def palm_cells(taxels):
        taxels[:, 80:320:16] = 0
        taxels[:, 85] = 0

    def tip(taxels):
        taxels[:, 16:32] = 0

    def line(taxels):
        taxels[:, 96:112] = 0

    for change, words in ((palm_cells, "16 taxels"), (tip, "fingertip"), (line, "16 taxels")):
        hand = Hand()
        verdicts = [hand(change) for _ in range(2)]
        (found,) = verdicts[-1].findings
        assert (found.code, found.level) == ("taxels_dead", "ERROR")
        assert words in found.message


def test_a_dead_scan_line_is_an_error_although_it_is_less_than_five_per_cent():
    # A raw column of the palm alone has 12 cells of 320; with the tips above it, 16.
    hand = Hand()
    column = [place for place in range(320) if hand.judge._indices[place] % 20 == 3]

    def change(taxels):
        taxels[:, column] = 0

    (found,) = [hand(change) for _ in range(2)][-1].findings
    assert found.level == "ERROR"
    assert "scan column 3" in found.message


def test_a_dead_taxel_stays_found_while_the_hand_rests():
    def change(taxels):
        taxels[:, 200] = TARE

    hand = Hand()
    for _ in range(2):
        hand(change)
    hand.pressed = False
    hand(change)
    assert codes(hand(change)) == {"taxels_dead": "WARN"}


@pytest.mark.parametrize(("drift_counts", "level"), [(2.0, None), (5.0, "WARN"), (-30.0, "ERROR")])
def test_the_zero_is_watched_at_rest(drift_counts, level):
    hand = Hand(drift_counts=drift_counts, pressed=False)
    for _ in range(3):
        verdict = hand()
    assert codes(verdict).get("baseline") == level
    assert verdict.figures["baseline_drift_ratio"] == pytest.approx(abs(drift_counts))
    hand.pressed = True
    hand()
    assert "baseline_drift_ratio" not in hand().figures


def test_neighbours_are_counted_on_their_own_pad():
    moved = np.zeros(320, dtype=np.bool_)
    moved[:16] = True
    share = neighbour_share(moved)
    assert np.all(share[:16] == 1.0)
    assert np.all(share[16:] == 0.0)
    moved[5] = False
    share = neighbour_share(moved)
    assert share[5] == 1.0
    assert share[0] == pytest.approx(2 / 3)


def test_a_takes_extremes_name_the_same_taxels(rng):
    low = np.full(360, 100, dtype=np.uint16)
    high = low + 800
    low[[228, 229, 250]] = high[[228, 229, 250]] = (0, 65535, 700)
    found = count_taxels(low, high, side="right")
    assert found == {"dead_taxels": 1, "stuck_taxels": 1, "saturated_taxels": 1}
    counters = StreamCounters()
    rows = rng.integers(100, 900, (50, 360)).astype(np.uint16)
    counters.add([Sample(index, row) for index, row in enumerate(rows)])
    np.testing.assert_array_equal(counters.low_counts, rows.min(axis=0))
    np.testing.assert_array_equal(counters.high_counts, rows.max(axis=0))
    assert counters.num_bytes == rows.nbytes


def test_encoded_images_count_their_bytes():
    counters = StreamCounters()
    values = np.empty(1, dtype=object)
    values[0] = b"x" * 321
    counters.add([Sample(0, values.reshape(()))])
    assert counters.num_bytes == 321
    assert counters.low_counts is None


def test_jumps_are_seen_by_the_devices_clock():
    judge = PoseCheck(pose_descriptor("head"))
    t_s = np.arange(100) / 100
    poses = np.zeros((100, 7))
    poses[:, 0] = 0.3 * t_s
    assert judged(judge, block(t_s, poses), SECOND_NS).findings == []
    poses[60:, 1] += 0.2
    verdict = judged(judge, block(1 + t_s, poses), 2 * SECOND_NS)
    assert codes(verdict) == {"jump": "WARN"}


@pytest.mark.parametrize(("tremble_m", "level"), [(2e-4, None), (2e-3, "WARN"), (8e-3, "ERROR")])
def test_trembling_is_judged_at_rest_only(rng, tremble_m, level):
    judge = PoseCheck(pose_descriptor("head"))
    t_s = np.arange(100) / 100
    poses = np.zeros((100, 7))
    poses[:, :3] = tremble_m / np.sqrt(3) * rng.standard_normal((100, 3))
    # Slower than 5 m/s from sample to sample, as a tracker's tremble is.
    verdict = judged(judge, block(t_s, poses), SECOND_NS)
    assert codes(verdict).get("pose_jitter") == level
    assert verdict.figures["stationary_jitter_meters"] == pytest.approx(tremble_m, rel=0.15)
    poses[:, 0] += t_s
    moving = judged(PoseCheck(pose_descriptor("head")), block(t_s, poses), SECOND_NS)
    assert "stationary_jitter_meters" not in moving.figures


def driver_of(decoder, kind=Driver):
    return kind("x", transport=HidPort("x").transport, decoder=decoder, clock=VirtualClock())


@pytest.mark.parametrize(
    ("kind", "count", "expected"),
    [
        ("occluded", 0, {}),
        ("occluded", 20, {"tracking": "WARN"}),
        ("occluded", 200, {"tracking": "ERROR"}),
        ("jumped", 1, {"jump": "WARN"}),
        ("stale", 100, {"tracking": "ERROR"}),
    ],
)
def test_what_a_trackers_decoder_leaves_out_is_judged(kind, count, expected):
    decoder = PoseTrackerDecoder("head")
    judge = TrackingCheck(driver_of(decoder).events)
    decoder.statistics.packets += 1000
    for _ in range(count):
        decoder.tracking[kind] += 1
    assert codes(judged(judge, block([]), SECOND_NS)) == expected


def test_values_that_are_no_numbers_are_counted_where_numbers_were():
    judge = FiniteCheck("tracking", "nodes are not seen")
    values = np.zeros((100, 25, 3), dtype=np.float32)
    values[:, 24] = np.nan
    assert judged(judge, block(np.arange(100) / 100, values), SECOND_NS).findings == []
    values[:, :5] = np.nan
    verdict = judged(judge, block(1 + np.arange(100) / 100, values), 2 * SECOND_NS)
    assert codes(verdict) == {"tracking": "ERROR"}
    assert verdict.figures["missing_ratio"] == pytest.approx(5 / 24 / 2)


class CheckedDriver(Driver):
    quality = ImageQuality()


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"frozen": True}, "image_frozen"),
        ({"fault": "torn"}, "image_content"),
        ({"blurred": True}, "image_blurred"),
        ({"gap": True}, "image_gap"),
        ({"clipped_ratio": 0.3}, "image_clipped"),
    ],
)
def test_bad_images_warn_and_are_an_error_after_a_second(change, code):
    driver = driver_of(PoseTrackerDecoder("head"), CheckedDriver)
    judge = CameraCheck(driver, "camera_head")
    assert judged(judge, block([]), 0).findings == []
    driver.quality = ImageQuality(**change)
    seen = [codes(judged(judge, block([t]), t * SECOND_NS)) for t in (1, 2)]
    # Light that pumps is of no camera's making.
    assert seen == [{code: "WARN"}, {code: "WARN" if code == "image_content" else "ERROR"}]
    driver.quality = ImageQuality()
    assert judged(judge, block([]), 3 * SECOND_NS).findings == []


def test_a_picture_that_stays_while_its_camera_moves_is_frozen():
    driver, bodies = driver_of(PoseTrackerDecoder("head"), CheckedDriver), BodiesCheck({})
    judge, tracker = CameraCheck(driver, "camera_head", bodies), bodies.of("head")
    driver.quality = ImageQuality(still_s=2.0)
    for turn_rad, expected in ((0.01, {}), (0.3, {"image_frozen": "WARN"})):
        t_s = np.arange(100) / 100
        angles = np.linspace(0, turn_rad, 100) / 2
        poses = np.zeros((100, 7))
        poses[:, 3], poses[:, 6] = np.cos(angles), np.sin(angles)
        judged(tracker, block(t_s, poses), SECOND_NS)
        assert codes(judged(judge, block(t_s), SECOND_NS)) == expected
    # What moved when the picture was still in its encoder, or after the camera went silent.
    judged(tracker, block(t_s + 1, poses), 2 * SECOND_NS)
    driver.quality = ImageQuality(still_s=2.0, fault="torn")
    judge = CameraCheck(driver, "camera_head", bodies)
    assert codes(judged(judge, block([]), 2 * SECOND_NS)) == {}
    driver.quality = ImageQuality(still_s=1.6)
    bodies = BodiesCheck({})
    judge, tracker = CameraCheck(driver, "camera_head", bodies), bodies.of("head")
    poses[:70], poses[70:, 3:] = [0, 0, 0, 1, 0, 0, 0], [0.5**0.5, 0, 0, 0.5**0.5]
    judged(tracker, block(t_s, poses), SECOND_NS)
    assert codes(judged(judge, block(t_s), SECOND_NS)) == {}


def test_blocks_are_bounded_and_count_what_they_lose():
    descriptor = StreamDescriptor(
        name="head",
        kind="pose",
        shape=(7,),
        dtype="float64",
        unit="pose_m_wxyz",
        nominal_rate_hz=100,
    )
    queue = SampleQueue(descriptor)
    for index in range(1000):
        queue.add([Sample(index, np.zeros(7))], index)
    assert queue.num_dropped == 600
    taken = queue.take()
    assert taken.t_host_ns.tolist() == list(range(600, 1000))
    assert len(queue.take()) == 0


class Tracker:
    """A wrist that moves about with noise, a second of 60 poses at a time."""

    def __init__(self):
        self.judge = PlausibilityCheck(pose_descriptor("wrist_left"))
        self.rng = np.random.default_rng(0)
        self.second = 0

    def __call__(self, change=lambda poses: poses):
        t_s = self.second + np.arange(60) / 60
        self.second += 1
        poses = np.zeros((60, 7))
        poses[:, 3] = 1
        poses[:, :3] = 0.2 * np.sin(2 * t_s[:, None] + [0, 1, 2])
        poses[:, :3] += 5e-4 * self.rng.standard_normal((60, 3))
        return codes(judged(self.judge, block(t_s, change(poses)), self.second * SECOND_NS))


def test_a_plausible_tracker_raises_nothing():
    tracker = Tracker()
    assert [tracker() for _ in range(15)] == [{}] * 15


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda poses: poses * ([1000] * 3 + [1] * 4), {"implausible": "ERROR"}),
        (lambda poses: poses * 3, {"implausible": "ERROR"}),
        (lambda poses: poses[[0] * 60], {"frozen": "WARN"}),
        (lambda poses: poses[np.arange(60) // 2 * 2], {}),
    ],
    ids=["millimetres", "no quaternions", "frozen", "repeated for a second"],
)
def test_what_cannot_be_true_is_found_as_it_comes_and_forgotten(change, expected):
    tracker = Tracker()
    for _ in range(3):
        assert tracker() == {}
    found = [tracker(change) for _ in range(2)]
    if expected:
        assert found[-1].keys() == expected.keys()
    for _ in range(12):
        last = tracker()
    assert last == {}


def test_poses_that_come_twice_are_found():
    tracker = Tracker()
    last = {}
    for _ in range(4):
        last = tracker(lambda poses: poses[np.arange(60) // 2 * 2])
    assert last == {"frozen": "WARN"}


def test_a_tracker_that_freezes_for_good_remains_frozen():
    tracker = Tracker()
    for _ in range(4):
        assert tracker() == {}
    kept = []
    found = [
        tracker(lambda poses: kept.append(poses[0]) or np.tile(kept[0], (60, 1))) for _ in range(20)
    ]
    assert found[1:] == [{"frozen": "ERROR"}] * 19
    assert tracker() == {} or tracker() == {"frozen": "ERROR"}


def test_joints_in_degrees_are_found_as_they_come():
    descriptor = StreamDescriptor(
        name="joints_measured", kind="robot_state", shape=(40,), dtype="float64", unit="rad",
        nominal_rate_hz=60,
    )  # fmt: skip
    t_s = np.arange(60) / 60
    joints = 0.3 + 0.1 * np.sin(t_s[:, None] + np.arange(40))
    for values, expected in ((joints, {}), (np.degrees(joints), {"implausible": "ERROR"})):
        judge = PlausibilityCheck(descriptor)
        evaluation = judged(judge, block(t_s, values), SECOND_NS)
        assert codes(evaluation) == expected
    assert "degrees" in evaluation.findings[0].message
