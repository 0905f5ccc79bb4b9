"""Sample times of a station whose NTP daemon slews the host's clock during a take."""

import sys
import time

import numpy as np
import pytest

from dextouch.clocks import OnlineClock
from dextouch.episodes.spool import SpoolReader
from dextouch.schemas import TakePrompt
from services.acquisition.clock import StationClock
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import DeviceFaults, FaultScript
from services.alignment.synchronization.stream_clock import time_stream
from tests.integration.recording_streams import human_streams
from tests.unit.acquisition.ledgers import true_times_ns
from tests.unit.acquisition.slewed_clock import SlewedClock
from tests.unit.acquisition.test_station_camera import MS, FakeCamera, image

SECONDS = 30.0
SLEW_AT_NS = 16_000_000_000
FAULTS = FaultScript(others=DeviceFaults(skew_ppm=50.0, path_delay_ms=2.0, jitter_ms=0.8))
BOUND_MS = 0.5


def online(batch, descriptor):
    clock = OnlineClock(descriptor)
    stamps = zip(*(a.tolist() for a in (batch.t_host_ns, batch.t_device_ns)), strict=True)
    return np.array([clock.update(t_host_ns=host, t_device_ns=dev) for host, dev in stamps])


@pytest.mark.long
@pytest.mark.parametrize("slew_ms", [50.0, -50.0])
def test_a_slewed_host_clock_moves_no_sample(slew_ms, tmp_path, capsys):
    """As in the field: chrony corrects 50 ms in 0.6 s, at its highest rate."""
    streams = [s for s in human_streams(SECONDS) if s.descriptor.name in {"tactile_left", "head"}]
    clock = SlewedClock(SLEW_AT_NS, round(slew_ms * MS))
    with MockStation(streams, FAULTS, 1, clock, spool_root=tmp_path) as station:
        take = station.run_take(TakePrompt(task="a", instruction="a"), recording_id="take")
    shown_ns = [clock.read_ns(which) for which in (time.CLOCK_BOOTTIME, time.CLOCK_MONOTONIC_RAW)]
    assert shown_ns[0] - shown_ns[1] == slew_ms * MS
    spool = SpoolReader(take.spool_path)
    for pair in station.pairs:
        name = pair.driver.descriptors[0].name
        batch, descriptor = spool.read(name), spool.streams[name]
        true_ns = true_times_ns(pair.device.ledger, batch.sequence) + 2 * MS
        timed = time_stream(batch, descriptor)
        after_ms = np.abs(timed.t_host_ns - true_ns[timed.kept]) * 1e-6
        live_ms = np.abs(online(batch, descriptor) - true_ns)[batch.t_host_ns > 11e9] * 1e-6
        with capsys.disabled():
            sys.stdout.write(
                f"\nhost slewed by {slew_ms:+.0f} ms, {name:12s} offline {after_ms.max():.3f} ms, "
                f"online {live_ms.max():.3f} ms at most, bound {BOUND_MS}"
            )
        assert timed.report.warnings == ()
        assert after_ms.max() <= BOUND_MS
        assert live_ms.max() <= BOUND_MS


def test_images_stamped_on_a_slewed_clock_are_where_they_were_taken():
    """V4L2 stamps CLOCK_MONOTONIC, which the slew moves under the stamps."""
    at_ns = 3 * 10**9
    clock = SlewedClock(at_ns, 50 * MS)
    steps = [image(k) for k in range(120)]
    taken_ns = np.array([step["stamp"] for step in steps])
    for step, t_ns in zip(steps, taken_ns.tolist(), strict=True):
        clock._now_ns = t_ns
        step["stamp"] = clock.read_ns(time.CLOCK_MONOTONIC)
    camera = FakeCamera(steps)
    camera.clock = clock
    clock.set_ns = lambda t_ns: setattr(clock, "_now_ns", t_ns)
    driver = camera.driver()
    driver.open()
    got_ns = [s.t_device_ns for _ in range(len(taken_ns)) for s in driver.read()["camera_head"]]
    driver.close()
    assert np.abs(np.array(got_ns) - taken_ns).max() <= BOUND_MS * MS


def test_the_real_clocks_never_go_back_and_agree():
    first, second = StationClock(), StationClock()
    readings = [clock.now_ns() for _ in range(5_000) for clock in (first, second)]
    assert (np.diff(readings[::2]) >= 0).all()
    assert (np.diff(readings[1::2]) >= 0).all()
    # Each knows the time in suspend to within a reading; chosen: a busy machine.
    assert abs(first.suspended_ns() - second.suspended_ns()) < MS
