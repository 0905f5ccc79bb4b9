"""Every fault that the mocks know, on real drivers in simulated time: found, named, soon."""

import pytest

from services.acquisition.clock import VirtualClock
from services.acquisition.mocks.faults import DeviceFaults, FaultScript
from services.acquisition.mocks.ledger import Fate
from services.acquisition.mocks.pattern import pattern_calibration, pattern_streams
from services.acquisition.mocks.station import MockStation
from services.acquisition.schemas import TakePrompt

PROMPT = TakePrompt(task="stack_bowls", instruction="stack the bowls")
# The device with the fault stands beside a head tracker that is never disturbed.
UNDISTURBED = "head"
GLOVE, FINGERS, WRIST = "glove_left", "finger_tracker_left", "pose_tracker_wrist_left"
STREAM_OF = {GLOVE: "tactile_left", FINGERS: "keypoints_left", WRIST: "wrist_left"}
ROUND_S = 4.0
AT_S = 1.5
SOON_S = 2.0
UNPLUG_S = 0.3
# Cells in the middle of the palm, which something presses all the time.
PALM_CELLS = (11 * 20 + 8, 11 * 20 + 9, 12 * 20 + 8, 13 * 20 + 11)

# What is done, to which device, and the code it must be found by (or one of two, where it depends
# on what the driver tells). Without a time of its own a
# fault begins with its first packet that did not arrive as it was sent.
FAULTS = {
    "drops": (GLOVE, {"drop_probability": 0.05}, "loss"),
    "bit_errors": (GLOVE, {"bit_error_rate": 1e-5}, "damage"),
    "byte_loss": (GLOVE, {"byte_loss_rate": 1e-4}, "damage"),
    "half_packets": (GLOVE, {"half_packet_probability": 0.05}, "damage"),
    "duplicates": (GLOVE, {"duplicate_probability": 0.05}, "repeated"),
    "reordering": (GLOVE, {"reorder_probability": 0.05}, "reordered"),
    "stall": (GLOVE, {"stalls_s": ((AT_S, AT_S + 0.4),)}, "silent"),
    "short_stall": (WRIST, {"stalls_s": ((AT_S, AT_S + 0.15),)}, "gap"),
    "bursts": (FINGERS, {"burst_ms": 100.0}, "jitter"),
    "clock_step": (GLOVE, {"clock_step_at_s": AT_S, "clock_step_s": 0.2}, "clock_step"),
    "clock_step_back": (GLOVE, {"clock_step_at_s": AT_S, "clock_step_s": -0.03}, "clock_step"),
    "clock_skew": (GLOVE, {"skew_ppm": 3000.0}, "clock_skew"),
    "wrong_hand": (GLOVE, {"wrong_side_from_s": AT_S}, "wrong_side rejected"),
    "version_change": (GLOVE, {"version_from_s": AT_S}, "wrong_version rejected"),
    "unplugged": (GLOVE, {"unplugged_s": ((AT_S, AT_S + 0.8),)}, "unplugged"),
    "unplugged_hid": (WRIST, {"unplugged_s": ((AT_S, AT_S + 0.8),)}, "unplugged"),
    "dead_taxels": (GLOVE, {"dead_taxels": PALM_CELLS}, "taxels_dead"),
    "stuck_taxels": (GLOVE, {"stuck_taxels": PALM_CELLS}, "taxels_stuck"),
    "saturated_taxels": (GLOVE, {"saturated_taxels": PALM_CELLS}, "taxels_saturated"),
    "nan": (WRIST, {"nan_probability": 0.05}, "refused"),
    "tracker_jumps": (WRIST, {"position_noise_m": 0.2}, "jump"),
}
HARMLESS = {
    "nothing": {},
    "counter_wrap": {"first_sequence": 2**32 - 60},
    "ordinary_skew_and_delay": {"skew_ppm": 50.0, "path_delay_ms": 3.0, "jitter_ms": 0.8},
}


def observe(tmp_path, device, changes):
    """Events of a take by stream and code (first time each was raised) and the ledger."""
    names = (STREAM_OF[device], UNDISTURBED)
    streams = [s for s in pattern_streams(ROUND_S) if s.descriptor.name in names]
    faults = FaultScript(devices={device: DeviceFaults(**changes)})
    mock = MockStation(
        streams,
        faults,
        5,
        VirtualClock(),
        spool_root=tmp_path,
        calibration=pattern_calibration(),
    )
    with mock:
        take = mock.run_take(PROMPT, recording_id="take")
        events = mock.station.health.events().events
    first = {}
    for event in events:
        if event.level != "OK":
            first.setdefault((event.stream, event.code), event)
    return first, take.ledger


def onset_ns(ledger, device, changes):
    """When the fault began, on the station's clock."""
    timed = {"stalls_s", "clock_step_at_s", "wrong_side_from_s", "version_from_s", "unplugged_s"}
    if timed & set(changes):
        return ledger.start_host_ns + round(AT_S * 1e9)
    entries = ledger.of(device)
    pairs = zip(entries.t_true_ns, entries.fate, strict=True)
    odd = [t_ns for t_ns, fate in pairs if fate != Fate.SENT]
    return odd[0] if odd else entries.t_true_ns[0]


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_found_and_named(fault, tmp_path, record_property):
    device, changes, right_codes = FAULTS[fault]
    first, ledger = observe(tmp_path, device, changes)
    stream = STREAM_OF[device]
    found = {c: e for (s, c), e in first.items() if s == stream}
    record_property("codes", " ".join(found))
    code = next((code for code in right_codes.split() if code in found), None)
    assert code is not None, f"{fault}: found only {sorted(found)}"
    delay_s = (found[code].t_host_ns - onset_ns(ledger, device, changes)) * 1e-9
    record_property("delay_s", round(delay_s, 2))
    limit_s = UNPLUG_S if code in {"unplugged", "silent"} else SOON_S
    assert delay_s <= limit_s + 1e-6
    assert {s for s, _ in first} == {stream}, "other streams are not accused"


@pytest.mark.parametrize("name", HARMLESS)
def test_what_is_no_fault_raises_nothing(name, tmp_path):
    first, _ = observe(tmp_path, GLOVE, HARMLESS[name])
    assert first == {}
