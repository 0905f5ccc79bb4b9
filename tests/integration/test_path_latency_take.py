"""A station measures its glove's path delay by itself, and the take carries it."""

import threading
from contextlib import closing

import numpy as np
import pytest

from dextouch.episodes.spool import SpoolReader
from dextouch.schemas import SaveTake, TakePrompt
from dextouch.streams import StreamDescriptor
from services.acquisition import watches
from services.acquisition.clock import StationClock
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.gloves import GloveCalibration, mock_glove
from services.acquisition.mocks.replay import MockSlot, ReplayStream
from services.acquisition.station import Station

SECONDS = 40
PATH_DELAY_MS = 12.0
PROMPT = TakePrompt(task="stand_bottle", instruction="stand the bottle up")


@pytest.fixture
def station(tmp_path, monkeypatch):
    monkeypatch.setattr(watches, "PERIOD_NS", 100_000_000)
    descriptor = StreamDescriptor(
        name="tactile_left",
        kind="tactile",
        shape=(320,),
        dtype="float32",
        unit="kPa",
        nominal_rate_hz=60,
    )
    count = SECONDS * 60
    t_ns = np.arange(count, dtype=np.int64) * 16_666_667
    stream = ReplayStream(descriptor, t_ns, np.zeros((count, 320), dtype=np.float32))
    clock, glove = StationClock(), GloveCalibration.seeded("left", 1)
    faults = DeviceFaults(path_delay_ms=PATH_DELAY_MS, jitter_ms=0.5, skew_ppm=60)
    pair = mock_glove(MockSlot("glove_left", stream, faults, 1, clock), calibration=glove)
    pair.device.port.plug()
    station = Station(
        name="test",
        drivers=[pair.driver],
        spool_root=tmp_path,
        clock=clock,
        calibration={
            "tactile_left_tare_counts": (tuple(glove.tare_counts.tolist()),),
            "tactile_left_gain_counts_per_kpa": (tuple(glove.gain_counts_per_kpa.tolist()),),
        },
    )
    station.start()
    station.wait_connected()
    waiter = clock.waiter()
    player = threading.Thread(
        target=pair.device.play, args=(clock, waiter), kwargs={"start_host_ns": clock.now_ns()}
    )
    player.start()
    yield station
    waiter.cancel()
    player.join()
    station.stop()
    pair.device.port.unplug()


def test_a_take_carries_the_measured_delay(station, tmp_path):
    clock = station.clock
    with closing(clock.waiter()) as waiter:
        end_ns = clock.now_ns() + (SECONDS - 4) * 10**9
        while not station.paths.latencies() and clock.now_ns() < end_ns:
            waiter.wait_until(clock.now_ns() + 50_000_000)
        # A busy computer may miss answers; those that came must suffice.
        assert station.paths.latencies(), station.paths.num_failures("tactile_left")
        station.recorder.arm(PROMPT)
        station.recorder.record("take")
        waiter.wait_until(clock.now_ns() + 500_000_000)
    station.health.evaluate()
    figures = station.health.report().streams[0].figures
    station.recorder.stop()
    station.recorder.save(SaveTake(accept_incomplete=True))
    calibration = SpoolReader(tmp_path / "take").attributes.calibration
    (latency_ns,), (sigma_ns,) = (
        calibration[f"tactile_left_latency{name}_ns"][0] for name in ("", "_sigma")
    )
    assert figures["path_latency_sigma_seconds"] > 0
    # A busy computer adds to the path; it takes nothing away.
    assert -3 * sigma_ns <= latency_ns - PATH_DELAY_MS * 1e6 <= 3 * sigma_ns + 3e6
