"""Each fault of the mocks: counted under a name, nothing invented, other streams as ever."""

import os

import numpy as np
import pytest

from dextouch.episodes.log import SpoolReader
from services.acquisition.clock import VirtualClock
from services.acquisition.mocks.faults import (
    SATURATED_COUNTS,
    STUCK_COUNTS,
    DeviceFaults,
    FaultScript,
)
from services.acquisition.mocks.ledger import Fate
from services.acquisition.mocks.station import MockStation
from services.acquisition.schemas import TakePrompt
from tests.integration.recording_streams import human_streams

PROMPT = TakePrompt(task="stack_bowls", instruction="stack the bowls")
SECONDS = 2.0
STREAMS = ("tactile_left", "keypoints_left", "wrist_left", "head", "camera_head")
GLOVE, FINGERS, TRACKER, CAMERA = (
    "glove_left",
    "finger_tracker_left",
    "pose_tracker_wrist_left",
    "camera_head",
)
WRAP = 2**32 - 40
# Fault, device, the event in the recording's ledger that tells of it (None: nothing is lost, the
# stamps or the health tell), and the fate in the mock's ledger that it must equal where it can.
SCRIPTS = {
    "bit_errors": (GLOVE, {"bit_error_rate": 2e-5}, "crc_errors", Fate.CORRUPTED),
    "byte_loss": (GLOVE, {"byte_loss_rate": 1e-4}, "resync_bytes", Fate.CORRUPTED),
    "drops": (TRACKER, {"drop_probability": 0.05}, "lost", Fate.DROPPED),
    "stall": (CAMERA, {"stalls_s": ((0.5, 1.3),)}, None, None),
    "bursts": (FINGERS, {"burst_ms": 80.0}, None, None),
    "duplicates_serial": (GLOVE, {"duplicate_probability": 0.1}, "repeated", Fate.REPEATED),
    "duplicates_hid": (TRACKER, {"duplicate_probability": 0.1}, "repeated", Fate.REPEATED),
    "reordering_serial": (GLOVE, {"reorder_probability": 0.1}, "late", Fate.LATE),
    "reordering_hid": (TRACKER, {"reorder_probability": 0.1}, "late", Fate.LATE),
    "clock_step": (GLOVE, {"clock_step_at_s": 1.0, "clock_step_s": 0.2}, None, None),
    "clock_step_back": (GLOVE, {"clock_step_at_s": 1.0, "clock_step_s": -0.03}, None, None),
    "skew": (GLOVE, {"skew_ppm": 5000.0}, None, None),
    "wrap_serial": (GLOVE, {"first_sequence": WRAP}, None, None),
    "wrap_hid": (FINGERS, {"first_sequence": WRAP}, None, None),
    "unplug_serial": (GLOVE, {"unplugged_s": ((0.6, 1.0),)}, "lost_device", None),
    "unplug_hid": (TRACKER, {"unplugged_s": ((0.6, 1.0),)}, "lost_device", None),
    "unplug_socket": (CAMERA, {"unplugged_s": ((0.6, 1.0),)}, "lost_device", None),
    "half_serial": (GLOVE, {"half_packet_probability": 0.1}, "lost", None),
    "half_hid": (FINGERS, {"half_packet_probability": 0.1}, "lost", None),
    "half_hid_report": (TRACKER, {"half_packet_probability": 0.1}, "lost", None),
    "half_socket": (CAMERA, {"half_packet_probability": 0.1}, "lost", None),
    "wrong_side": (GLOVE, {"wrong_side_from_s": 1.0}, "wrong_side", None),
    "wrong_side_hid": (FINGERS, {"wrong_side_from_s": 1.0}, "wrong_side", None),
    "version": (TRACKER, {"version_from_s": 1.0}, "wrong_version", None),
    "dead": (GLOVE, {"dead_taxels": (3, 200)}, None, None),
    "stuck": (GLOVE, {"stuck_taxels": (3, 200)}, None, None),
    "saturated": (GLOVE, {"saturated_taxels": (3, 200)}, None, None),
    "nan_pose": (TRACKER, {"nan_probability": 0.1}, "refused", Fate.REFUSED),
}
PINNED = {"dead": 0, "stuck": STUCK_COUNTS, "saturated": SATURATED_COUNTS}


def record(faults, folder):
    streams = [s for s in human_streams(SECONDS) if s.descriptor.name in STREAMS]
    with MockStation(streams, faults, 5, VirtualClock(), spool_root=folder) as station:
        take = station.run_take(PROMPT, recording_id="take")
        addresses = {p.device.name: str(p.driver.info) for p in station.pairs}
        errors = {s.driver.name: s.counters.last_error or "" for s in station.station.supervisors}
    return take, SpoolReader(take.spool_path), addresses, errors


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    _, spool, _, _ = record(FaultScript(), tmp_path_factory.mktemp("undisturbed"))
    return {name: spool.read(name) for name in spool.streams}


def assert_same(batch, expected):
    np.testing.assert_array_equal(batch.sequence, expected.sequence)
    np.testing.assert_array_equal(batch.t_host_ns, expected.t_host_ns)
    np.testing.assert_array_equal(batch.values, expected.values)


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_fault_is_counted_and_nothing_is_invented(name, undisturbed, tmp_path):
    device, fault, event, fate = SCRIPTS[name]
    take, spool, _, errors = record(
        FaultScript(devices={device: DeviceFaults.model_validate(fault)}), tmp_path
    )
    (stream,) = [n for n, d in spool.streams.items() if d.device == device]
    ledger, batch = take.ledger.of(device), spool.read(stream)

    # Nothing is invented: every sample is one that the device sent whole, in its order, once.
    sequence = batch.sequence % 2**32
    accepted = ledger.accepted()
    assert set(sequence.tolist()) <= set(accepted)
    places = {s: place for place, s in enumerate(ledger.sequence)}
    order = np.array([places[int(s)] for s in sequence])
    assert np.all(np.diff(order) > 0)
    if name not in PINNED:
        np.testing.assert_array_equal(batch.values, undisturbed[stream].values[order])
    if not name.startswith("wrong_side") and name != "version":
        # Nor is anything lost that arrived whole, but for the packets that a line fault touched
        # with their neighbours (a half one swallows bytes of the next until the sum is wrong).
        assert len(batch) == len(accepted)

    # It is told under a name, as often as it happened.
    entries = {e.event: e.count for e in spool.attributes.ledger if e.stream == stream}
    if event is not None:
        assert entries.get(event, 0) > 0, entries
    if event is not None and fate is not None and event != "resync_bytes":
        assert entries[event] == ledger.count(fate) > 0
    if name.startswith("wrong_side"):
        assert "is the wrong one plugged in?" in errors[device]
    if name == "version":
        assert "packet version 2" in errors[device]
    if name in PINNED:
        assert np.all(batch.values[:, [3, 200]] == PINNED[name])
    if name in ("stall", "version", "unplug_serial"):
        assert ("gap", "ERROR") in {
            (p.code, p.level) for p in take.check.problems if p.stream == stream
        }

    # The other streams have not noticed.
    for other in set(spool.streams) - {stream}:
        assert_same(spool.read(other), undisturbed[other])
        assert [e.event for e in spool.attributes.ledger if e.stream == other] == []


def test_a_replugged_glove_has_another_port(tmp_path):
    faults = FaultScript(devices={GLOVE: DeviceFaults(unplugged_s=((0.6, 1.0),))})
    streams = [s for s in human_streams(SECONDS) if s.descriptor.name == "tactile_left"]
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
