"""The history of a station's health against the script and ledger of the faults of its mocks."""

import numpy as np
import pytest

from dextouch.schemas import TakePrompt
from services.acquisition.clock import VirtualClock
from services.acquisition.health.history import STREAM_SERIES
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import DeviceFaults, Fate, FaultScript
from services.acquisition.mocks.pattern import pattern_calibration, pattern_streams

PROMPT = TakePrompt(task="stack_bowls", instruction="stack the bowls")
SECONDS = 30.0
STALL_S, UNPLUGGED_S, STEP_AT_S, STEP_S = (8.0, 10.5), (15.0, 18.0), 20.0, -0.2
SKEW_PPM, DROPS = 80.0, 0.05
# Rows are a second long and begin anywhere; what a row shows began at most so long before its time.
ROW_S = 1.1
FAULTS = FaultScript(
    devices={
        "glove_left": DeviceFaults(stalls_s=(STALL_S,)),
        "glove_right": DeviceFaults(drop_probability=DROPS),
        "pose_tracker_head": DeviceFaults(unplugged_s=(UNPLUGGED_S,)),
        "pose_tracker_wrist_left": DeviceFaults(
            clock_step_at_s=STEP_AT_S, clock_step_s=STEP_S, skew_ppm=SKEW_PPM
        ),
        "pose_tracker_wrist_right": DeviceFaults(jitter_ms=4.0),
    }
)
STREAMS = ("tactile_left", "tactile_right", "head", "wrist_left", "wrist_right")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Rows by stream and series with their time since the beginning of the script; the take."""
    streams = [s for s in pattern_streams(SECONDS) if s.descriptor.name in STREAMS]
    spool = tmp_path_factory.mktemp("spool")
    calibration = pattern_calibration()
    mock = MockStation(
        streams, FAULTS, 5, VirtualClock(), spool_root=spool, calibration=calibration
    )
    with mock:
        take = mock.run_take(PROMPT, recording_id="take")
        rows, takes = mock.station.health.history.rows(), mock.station.health.history.takes()
    t_s = (rows.t_ns - take.ledger.start_host_ns) * 1e-9
    # The first row has nothing before it that it could be measured from.
    inside = (t_s > 1.0) & (t_s < SECONDS)
    values = {
        stream: dict(zip(STREAM_SERIES, rows.values[index][:, inside], strict=True))
        for index, stream in enumerate(rows.streams)
    }
    return t_s[inside], values, take, takes


def overlap_s(t_s, span_s):
    """How much of each row's second lies in a span."""
    begins_s = np.concatenate([[t_s[0] - 1.0], t_s[:-1]])
    return np.clip(np.minimum(t_s, span_s[1]) - np.maximum(begins_s, span_s[0]), 0, None)


def test_there_is_a_row_a_second(recorded):
    t_s, _, _, _ = recorded
    assert len(t_s) >= 26
    assert np.diff(t_s).min() == pytest.approx(1.0, abs=1e-6)
    assert np.diff(t_s).max() <= ROW_S


@pytest.mark.parametrize(
    ("stream", "span_s", "late_s"),
    [("tactile_left", STALL_S, 0.05), ("head", UNPLUGGED_S, 0.3)],
    ids=["stall", "plug"],
)
def test_silences_are_where_the_script_has_them(recorded, stream, span_s, late_s):
    t_s, values, _, _ = recorded
    inside_s = overlap_s(t_s, span_s)
    seconds = np.diff(t_s, prepend=t_s[0] - 1.0)
    gaps_s = values[stream]["gap_ratio"] * seconds
    # A gap begins with the last sample before, and ends with the first after opening it again,
    # which a busy machine may only do at the next try.
    np.testing.assert_allclose(gaps_s, inside_s, atol=late_s)
    assert gaps_s.sum() == pytest.approx(span_s[1] - span_s[0], abs=late_s)
    rate_hz, is_all = values[stream]["rate_hz"], inside_s > seconds - 1e-6
    assert is_all.sum() >= 1
    nominal_hz = {"tactile_left": 60, "head": 100}[stream]
    assert rate_hz[is_all].max() < 0.02 * nominal_hz
    quiet = overlap_s(t_s, (span_s[0] - ROW_S, span_s[1] + 2 * ROW_S)) == 0
    np.testing.assert_allclose(rate_hz[quiet], nominal_hz, rtol=0.02)
    assert values[stream]["level"][is_all].max() == 3  # STALE
    assert values[stream]["age_s"].max() <= span_s[1] - span_s[0] + 0.05 + late_s


def test_losses_are_those_of_the_ledger(recorded):
    t_s, values, take, _ = recorded
    ledger = take.ledger.of("glove_right")
    arrival_s = (np.array(ledger.t_arrival_ns) - take.ledger.start_host_ns) * 1e-9
    dropped = np.array(ledger.fate) == Fate.DROPPED
    edges_s = np.concatenate([[t_s[0] - 1.0], t_s])
    lost, _ = np.histogram(arrival_s[dropped], edges_s)
    sent, _ = np.histogram(arrival_s, edges_s)
    assert lost.sum() > 50
    # A loss is noticed with the next packet, which may be in the next row.
    shown = values["tactile_right"]["loss_ratio"] * sent
    np.testing.assert_allclose(np.cumsum(shown), np.cumsum(lost), atol=2.0)
    assert np.nanmax(values["wrist_right"]["loss_ratio"]) == 0


def test_a_clock_steps_when_it_does_and_drifts_as_it_does(recorded):
    t_s, values, _, _ = recorded
    wrist = values["wrist_left"]
    offset_s = wrist["clock_offset_s"] - wrist["clock_offset_s"][0]
    # Host minus device: a device that is set back lags by the step from then on.
    expected_s = -1e-6 * SKEW_PPM * (t_s - t_s[0]) - STEP_S * (t_s >= STEP_AT_S)
    steady = np.abs(t_s - STEP_AT_S - ROW_S) > ROW_S
    np.testing.assert_allclose(offset_s[steady], expected_s[steady], atol=2e-3)
    drift_ppm = wrist["clock_skew_ppm"][(t_s > 12) & (t_s < STEP_AT_S)]
    np.testing.assert_allclose(drift_ppm, -SKEW_PPM, atol=5)
    assert np.abs(values["wrist_right"]["clock_skew_ppm"][t_s > 12]).max() < 60


def test_scatter_is_that_of_the_script(recorded):
    t_s, values, _, _ = recorded
    # 95 % of an exponential of 4 ms are within 4 ln(20) ms = 12 ms; less its median of 2.8 ms.
    residual_s = values["wrist_right"]["clock_residual_s"][t_s > 11]
    assert np.median(residual_s) == pytest.approx(9.2e-3, rel=0.3)
    assert np.nanmax(values["tactile_left"]["clock_residual_s"][t_s < STALL_S[0]]) < 1e-3
    p95_s = values["wrist_right"]["interval_p95_s"]
    assert np.median(p95_s) > 1.2 * 0.01


def test_the_take_is_marked(recorded):
    _, _, take, takes = recorded
    (marked,) = takes
    assert marked.recording_id == "take"
    start_s, stop_s = (
        (t - take.ledger.start_host_ns) * 1e-9 for t in (marked.start_ns, marked.stop_ns)
    )
    assert start_s == pytest.approx(0.0, abs=0.1)
    assert stop_s == pytest.approx(SECONDS, abs=0.3)
