"""Each fault of the mocks: counted under a name, nothing invented, other streams as ever."""

import os
from contextlib import nullcontext
from typing import NamedTuple

import numpy as np
import pytest

from dextouch.episodes.spool import SpoolReader
from dextouch.schemas import TakePrompt
from services.acquisition.clock import VirtualClock
from services.acquisition.devices.robot_state import STREAM_SIZES
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import DeviceFaults, Fate, FaultScript
from services.acquisition.settings import MockLinks
from tests.integration.recording_streams import human_streams, robot_streams, stream
from tests.unit.acquisition.ledgers import accepted
from tests.unit.acquisition.usb_bus import usb_trackers

PROMPT = TakePrompt(task="stack_bowls", instruction="stack the bowls")
GLOVE, FINGERS, TRACKER, CAMERA = (
    "glove_left",
    "finger_tracker_left",
    "pose_tracker_wrist_left",
    "camera_head",
)
STREAM_OF = {
    GLOVE: "tactile_left",
    FINGERS: "keypoints_left",
    TRACKER: "wrist_left",
    CAMERA: "camera_head",
}
# What stands beside the device with the fault.
NEIGHBOR = "head"
WRAP = 2**32 - 40
OURS = MockLinks()
USB, BRIDGE = "trackers on USB", MockLinks(trackers="bridge")
WUJI, JUSTFLOAT = MockLinks(gloves="wuji_glove"), MockLinks(gloves="justfloat_glove")
OWN_CAMERA = MockLinks(cameras="station")


class Script(NamedTuple):
    """What is done to which device, and how the take's ledger must tell it.

    `events` are in the ledger; where `fate` is given, the first of them is counted as often as the
    mock's ledger tells of it.
    """

    device: str
    fault: dict
    events: tuple[str, ...]
    fate: Fate | None = None
    links: MockLinks | str = OURS
    seconds: float = 1.3


def unplugged(device, links=OURS):
    return Script(device, {"unplugged_s": ((0.5, 0.9),)}, ("lost_device", "unplugged"), None, links)


def stalled(device, links=OURS):
    return Script(device, {"stalls_s": ((0.4, 1.1),)}, ("silent",), None, links)


def dropped(device, links=OURS):
    return Script(device, {"drop_probability": 0.1}, ("lost", "loss"), Fate.DROPPED, links)


def repeated(device, links=OURS):
    return Script(device, {"duplicate_probability": 0.1}, ("repeated",), Fate.REPEATED, links)


def reordered(device, links=OURS):
    return Script(device, {"reorder_probability": 0.1}, ("late",), Fate.LATE, links)


def halved(device, links=OURS, event="lost"):
    fate = Fate.HALF if event == "lost" else None
    return Script(device, {"half_packet_probability": 0.1}, (event,), fate, links)


def nan(device, event, fate, links=OURS):
    return Script(device, {"nan_probability": 0.1}, (event,), fate, links)


def from_1_s(device, fault, event, links=OURS):
    return Script(device, {f"{fault}_from_s": 1.0}, (event,), None, links)


def out_of_sight(links):
    return Script(TRACKER, {"occluded_s": ((0.6, 0.9),)}, ("occluded",), Fate.OCCLUDED, links)


def not_running(links):
    return Script(TRACKER, {"not_running_s": ((0.6, 0.9),)}, ("occluded",), Fate.OCCLUDED, links)


def jumping(links):
    return Script(TRACKER, {"jumped_s": ((0.6, 0.7),)}, ("jumped",), Fate.JUMPED, links)


def thumb_hidden(links):
    return Script(FINGERS, {"occluded_s": ((0.6, 0.9),)}, ("unseen_nodes",), None, links)


SCRIPTS = {
    "bit errors": Script(GLOVE, {"bit_error_rate": 2e-5}, ("crc_errors",), Fate.CORRUPTED),
    "byte loss": Script(GLOVE, {"byte_loss_rate": 1e-4}, ("lost", "resync_bytes"), Fate.CORRUPTED),
    "drops": dropped(TRACKER),
    "stall": stalled(CAMERA),
    "bursts": Script(FINGERS, {"burst_ms": 80.0}, ("jitter",)),
    "duplicates, serial": repeated(GLOVE),
    "duplicates, hid": repeated(TRACKER),
    "duplicates, socket": repeated(CAMERA),
    "reordering, serial": reordered(GLOVE),
    "reordering, hid": reordered(TRACKER),
    "clock step": Script(
        GLOVE, {"clock_step_at_s": 1.5, "clock_step_s": 0.2}, ("clock_step",), seconds=3.0
    ),
    "clock step back": Script(
        GLOVE, {"clock_step_at_s": 1.5, "clock_step_s": -0.03}, ("clock_step",), seconds=3.0
    ),
    "skew": Script(GLOVE, {"skew_ppm": 5000.0}, ("clock_skew",), seconds=2.0),
    # A counter that wraps has lost nothing: it must not be told as anything.
    "wrap, serial": Script(GLOVE, {"first_sequence": WRAP}, ()),
    "wrap, hid": Script(FINGERS, {"first_sequence": WRAP}, ()),
    "unplug, serial": unplugged(GLOVE),
    "unplug, hid": unplugged(TRACKER),
    "unplug, socket": unplugged(CAMERA),
    "half, serial": halved(GLOVE),
    "half, hid": halved(FINGERS),
    "half, one report": halved(TRACKER),
    "half, socket": halved(CAMERA),
    "wrong side, serial": from_1_s(GLOVE, "wrong_side", "wrong_side"),
    "wrong side, hid": from_1_s(FINGERS, "wrong_side", "wrong_side"),
    "version": from_1_s(TRACKER, "version", "wrong_version"),
    "dead": Script(GLOVE, {"dead_taxels": (3, 200)}, ("dead_taxels",)),
    "stuck": Script(GLOVE, {"stuck_taxels": (3, 200)}, ("stuck_taxels",)),
    "saturated": Script(GLOVE, {"saturated_taxels": (3, 200)}, ("saturated_taxels",)),
    "nan, pose": nan(TRACKER, "refused", Fate.REFUSED),
    "nan, node": nan(FINGERS, "unseen_nodes", Fate.MARKED),
    "out of sight": out_of_sight(OURS),
    "not running": not_running(OURS),
    "jumps": jumping(OURS),
    "thumb hidden": thumb_hidden(OURS),
    "drops, usb": dropped(TRACKER, USB),
    "unplug, usb": unplugged(FINGERS, USB),
    "wrong side, usb": from_1_s(TRACKER, "wrong_side", "wrong_side", USB),
    "duplicates, bridge": repeated(TRACKER, BRIDGE),
    "reordering, bridge": reordered(TRACKER, BRIDGE),
    "half, bridge": halved(FINGERS, BRIDGE),
    "unplug, bridge": unplugged(FINGERS, BRIDGE),
    "version, bridge": from_1_s(FINGERS, "version", "wrong_version", BRIDGE),
    "wrong side, bridge": from_1_s(TRACKER, "wrong_side", "wrong_side", BRIDGE),
    "nan, bridge": nan(TRACKER, "refused", Fate.REFUSED, BRIDGE),
    "not running, bridge": not_running(BRIDGE),
    "jumps, bridge": jumping(BRIDGE),
    "thumb hidden, bridge": thumb_hidden(BRIDGE),
    "bit errors, wuji": Script(
        GLOVE, {"bit_error_rate": 4e-6}, ("crc_errors",), Fate.CORRUPTED, WUJI
    ),
    "byte loss, wuji": Script(GLOVE, {"byte_loss_rate": 3e-5}, ("lost",), Fate.CORRUPTED, WUJI),
    "duplicates, wuji": repeated(GLOVE, WUJI),
    "reordering, wuji": reordered(GLOVE, WUJI),
    "half, wuji": halved(GLOVE, WUJI),
    "wrap, wuji": Script(GLOVE, {"first_sequence": 2**16 - 40}, (), None, WUJI),
    "unplug, wuji": unplugged(GLOVE, WUJI),
    "wrong side, wuji": from_1_s(GLOVE, "wrong_side", "wrong_side", WUJI),
    "dead, wuji": Script(GLOVE, {"dead_taxels": (66, 72)}, ("taxels_dead",), None, WUJI, 1.6),
    "saturated, wuji": Script(
        GLOVE, {"saturated_taxels": (66, 72)}, ("taxels_saturated",), None, WUJI, 1.6
    ),
    "nan, wuji": nan(GLOVE, "nan", None, WUJI),
    # This glove has no checksum, number or time: what only these could show is not told.
    "byte loss, justfloat": Script(
        GLOVE, {"byte_loss_rate": 1e-4}, ("length_errors",), None, JUSTFLOAT
    ),
    "half, justfloat": halved(GLOVE, JUSTFLOAT, "length_errors"),
    "nan, justfloat": nan(GLOVE, "suspects", Fate.REFUSED, JUSTFLOAT),
    "unplug, justfloat": unplugged(GLOVE, JUSTFLOAT),
    "stall, justfloat": stalled(GLOVE, JUSTFLOAT),
    "drops, own camera": dropped(CAMERA, OWN_CAMERA),
    "duplicates, own camera": repeated(CAMERA, OWN_CAMERA),
    "half, own camera": Script(
        CAMERA, {"half_packet_probability": 0.1}, ("refused",), Fate.HALF, OWN_CAMERA
    ),
    "unplug, own camera": unplugged(CAMERA, OWN_CAMERA),
    "stall, own camera": stalled(CAMERA, OWN_CAMERA),
}
# What the device throws the link away for, and with it what came in the same moment.
REFUSED_DEVICE = ("wrong_side", "wrong_version")
PINNED = {"dead": 0, "stuck": 1_000, "saturated": 65_535, "dead, wuji": 0.0, "saturated, wuji": 1.0}


def record(script, fault, folder):
    names = (STREAM_OF[script.device], NEIGHBOR)
    streams = [s for s in human_streams(script.seconds) if s.descriptor.name in names]
    faults = FaultScript(devices={script.device: DeviceFaults.model_validate(fault)})
    by_usb = script.links == USB
    with usb_trackers() if by_usb else nullcontext():
        links = OURS if by_usb else script.links
        station = MockStation(streams, faults, 5, VirtualClock(), spool_root=folder, links=links)
    with station:
        take = station.run_take(PROMPT, recording_id="take")
        errors = {s.driver.name: s.last_error or "" for s in station.station.supervisors}
    return take, SpoolReader(take.spool_path), errors


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The same take without a fault: batches by stream, and the ledger."""
    made = {}

    def take(script):
        key = (script.device, script.links, script.seconds)
        if key not in made:
            _, spool, _ = record(script, {}, tmp_path_factory.mktemp("undisturbed"))
            batches = {name: spool.read(name) for name in spool.streams}
            made[key] = batches, ledger_of(spool)
        return made[key]

    return take


def ledger_of(spool):
    entries = {}
    for entry in spool.attributes.ledger:
        entries.setdefault(entry.stream, {})[entry.event] = entry.count
    return entries


def assert_same(batch, expected):
    np.testing.assert_array_equal(batch.sequence, expected.sequence)
    np.testing.assert_array_equal(batch.t_host_ns, expected.t_host_ns)
    np.testing.assert_array_equal(batch.values, expected.values)


def places_in(batch, descriptor, ledger, truth):
    """Which of the device's packets each sample is."""
    if descriptor.kind == "image" and not descriptor.capabilities.sequence:
        # A camera of the station's own counts from its first whole image on, by its stamps.
        return batch.sequence + ledger.fate.index(Fate.SENT)
    if descriptor.capabilities.sequence:
        modulus = 1 << descriptor.capabilities.sequence_bits
        places = {s % modulus: place for place, s in enumerate(ledger.sequence)}
        return np.array([places[int(s) % modulus] for s in batch.sequence], dtype=np.int64)
    # A device without numbers: its samples must be found among the true ones, in order.
    found, place = [], 0
    for values in batch.values:
        while not np.array_equal(truth[place], values):
            place += 1
        found.append(place)
        place += 1
    return np.array(found, dtype=np.int64)


def assert_not_invented(batch, truth):
    """All that is there is as it was; what is missing is marked as NaN."""
    if batch.values.dtype.kind != "f":
        np.testing.assert_array_equal(batch.values, truth)
        return
    there = np.isfinite(batch.values)
    np.testing.assert_array_equal(batch.values[there], truth[there])


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_fault_is_counted_and_nothing_is_invented(name, undisturbed, tmp_path):
    script = SCRIPTS[name]
    take, spool, errors = record(script, script.fault, tmp_path)
    stream = STREAM_OF[script.device]
    descriptor, batch = spool.streams[stream], spool.read(stream)
    ledger = take.ledger.of(script.device)
    batches, entries_before = undisturbed(script)
    truth, entries = batches[stream].values.copy(), ledger_of(spool)

    # Every sample is one that the device sent whole, as it was, in its order, once.
    places = places_in(batch, descriptor, ledger, truth)
    assert np.all(np.diff(places) > 0)
    if descriptor.capabilities.sequence:
        arrived = set(accepted(ledger))
        assert {ledger.sequence[place] for place in places} <= arrived
        if not set(script.events) & set(REFUSED_DEVICE):
            assert len(batch) == len(arrived), "what arrived whole is there"
    if name in PINNED:
        pinned = list(next(iter(script.fault.values())))
        assert np.all(batch.values[:, pinned] == PINNED[name])
        truth[:, pinned] = PINNED[name]
    assert_not_invented(batch, truth[places])

    # It is told under a name, as often as it happened, by both ledgers.
    own = entries.get(stream, {})
    assert set(script.events) <= set(own), own
    assert "restarts" not in own, "no fault of these restarts a device"
    if script.fate is not None:
        told = ledger.count(script.fate)
        if script.events[0] == "lost":
            # What comes before the first sample or behind the last one is not missed by anybody.
            told = ledger.count_lost_between()
        assert own[script.events[0]] == told > 0
    if not script.events:
        assert own == entries_before.get(stream, {})
    assert DeviceFaults.model_validate(ledger.script) == DeviceFaults.model_validate(script.fault)
    if "wrong_version" in script.events:
        assert "packet version 2" in errors[script.device]

    # The other stream has not noticed.
    assert_same(spool.read(NEIGHBOR), batches[NEIGHBOR])
    assert entries.get(NEIGHBOR) == entries_before.get(NEIGHBOR)


@pytest.mark.parametrize(
    ("fault", "event", "fate"),
    [
        ("nan_probability", "refused", Fate.REFUSED),
        ("reorder_probability", "late", Fate.LATE),
        ("duplicate_probability", "repeated", Fate.REPEATED),
    ],
)
def test_a_packet_of_many_streams_is_counted_once_in_each(fault, event, fate, tmp_path):
    streams = [s for s in robot_streams(1.3) if s.descriptor.name in STREAM_SIZES]
    faults = FaultScript(others=DeviceFaults.model_validate({fault: 0.1}))
    with MockStation(streams, faults, 5, VirtualClock(), spool_root=tmp_path) as station:
        take = station.run_take(PROMPT, recording_id="take")
    entries = ledger_of(SpoolReader(take.spool_path))
    told = take.ledger.of("robot_state").count(fate)
    assert told > 0
    assert {name: entries[name][event] for name in STREAM_SIZES} == dict.fromkeys(
        STREAM_SIZES, told
    )


@pytest.mark.parametrize("name", ["stall", "version", "unplug, serial"])
def test_a_long_silence_makes_the_take_incomplete(name, tmp_path):
    script = SCRIPTS[name]
    take, _, _ = record(script, script.fault, tmp_path)
    gaps = {p.stream for p in take.check.problems if (p.code, p.level) == ("gap", "ERROR")}
    assert gaps == {STREAM_OF[script.device]}


def test_a_replugged_glove_has_another_port(tmp_path):
    faults = FaultScript(devices={GLOVE: DeviceFaults(unplugged_s=((0.6, 1.0),))})
    streams = [s for s in human_streams(2.0) if s.descriptor.name == "tactile_left"]
    with MockStation(streams, faults, 5, VirtualClock(), spool_root=tmp_path) as station:
        driver = station.pairs[0].driver
        before = str(driver.info)
        # The system gives the lowest free number, so something else must have taken the old one.
        port = station.pairs[0].device.port
        plug, taken = port.plug, []

        def plug_elsewhere():
            taken.extend(os.openpty())
            plug()

        port.plug = plug_elsewhere
        take = station.run_take(PROMPT, recording_id="take")
        after = str(driver.info)
        for descriptor in taken:
            os.close(descriptor)
    assert before != after
    assert SpoolReader(take.spool_path).read("tactile_left").sequence[-1] == 119


def test_what_images_are_like_reaches_ledger_check_and_quality(tmp_path):
    def table(t_s):
        """Rows of a fine pattern, which the lens loses from 1.5 s on."""
        rows, columns = np.mgrid[0:64, 0:64]
        fine = 120 + 60 * ((rows // 8 + columns // 8) % 2)
        soft = np.full((64, 64), 150.0)
        images = np.where(t_s[:, None, None] < 1.5, fine, soft)
        moving = images + (40 * t_s % 20)[:, None, None]
        return np.repeat(moving[..., None], 3, axis=-1).astype(np.uint8)

    streams = [stream(CAMERA, "image", 30, table, "rgb8", 3.0)]
    with MockStation(streams, FaultScript(), 5, VirtualClock(), spool_root=tmp_path) as station:
        take = station.run_take(PROMPT, recording_id="take")
        quality = station.pairs[0].driver.quality
    attributes = SpoolReader(take.spool_path).attributes
    assert quality.num_blurred > 0
    entries = {e.event: e.count for e in attributes.ledger}
    assert entries["image_blurred"] == quality.num_blurred
    assert attributes.quality["camera_head_num_image_blurred"] == quality.num_blurred
    assert attributes.quality["camera_head_worst_image_blurred"] == 1.0
    (problem,) = [p for p in take.check.problems if p.code == "image_blurred"]
    assert (problem.stream, problem.level) == (CAMERA, "WARN")
    # Nobody needs to clean the lens of a simulated camera.
    assert "Clean the lens" not in problem.message
