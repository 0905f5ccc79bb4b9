"""Path delays that gloves' answers tell, against what was injected into the mocks."""

import sys
import threading
import time
from contextlib import closing

import numpy as np

from dextouch.streams import StreamDescriptor
from services.acquisition.clock import StationClock, VirtualClock, Waiter
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.gloves import GloveCalibration, mock_glove
from services.acquisition.mocks.replay import MockSlot, ReplayStream
from services.acquisition.supervisor import DeviceSupervisor
from services.acquisition.watches import PathWatch

SECONDS = 4.0
PERIOD_NS = 16_666_667
LOOK_PERIOD_NS = 100_000_000
# A busy computer may leave a request unanswered; what is asked after the take counts as well.
PATIENCE_S = 60.0


def truth():
    count = int(SECONDS * 60)
    descriptor = StreamDescriptor(
        name="tactile_left",
        kind="tactile",
        shape=(320,),
        dtype="float32",
        unit="kPa",
        nominal_rate_hz=60,
    )
    values = np.zeros((count, 320), dtype=np.float32)
    return ReplayStream(descriptor, np.arange(count, dtype=np.int64) * PERIOD_NS, values)


class SimulatedHost(VirtualClock):
    """A host whose time passes only between events and with every look at the clock.

    Stamps then say what they would on an idle computer, however busy this one is.
    """

    def __init__(self, seed):
        super().__init__()
        self._rng = np.random.default_rng(seed)
        self._ticking = threading.Lock()

    def now_ns(self):
        with self._ticking:
            self._now_ns += int(self._rng.exponential(0.1e6))
            return self._now_ns

    def go_on_to(self, t_ns):
        with self._ticking:
            self._now_ns = max(self._now_ns, t_ns)


class Playing(Waiter):
    """The waiter of a device that plays: time goes on, and ten times a second answers are asked."""

    def __init__(self, host, watch):
        self._host, self._watch = host, watch
        self._next_look_ns = 0

    def wait_until(self, t_ns):
        self._host.go_on_to(t_ns)
        if t_ns >= self._next_look_ns:
            self._next_look_ns = t_ns + LOOK_PERIOD_NS
            self._watch.look()
        return True

    def cancel(self):
        """Nobody does."""

    def close(self):
        """Nothing to do."""


class Glove:
    """A mock glove that plays, its reader, and what its answers tell."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        self.host = SimulatedHost(seed)
        self.faults = DeviceFaults(
            path_delay_ms=float(rng.uniform(0.5, 40.0)),
            jitter_ms=float(rng.uniform(0.2, 1.5)),
            skew_ppm=float(rng.uniform(-80, 80)),
        )
        pair = mock_glove(
            MockSlot("glove_left", truth(), self.faults, seed, self.host),
            calibration=GloveCalibration.seeded("left", seed),
        )
        self.device = pair.device
        self.device.port.plug()
        self.arrivals = []
        self.supervisor = DeviceSupervisor(pair.driver, sink=self._accept, clock=self.host)
        # Nothing is asked by a virtual clock, whose time would stand still meanwhile; this one's
        # goes on.
        self.watch = PathWatch([self.supervisor], clock=StationClock())

    def _accept(self, readings):
        self.watch.accept(readings)
        self.arrivals += [(s.sequence, s.t_host_ns) for s in readings["tactile_left"]]

    def play(self):
        """The whole take; its path delay at the end."""
        self.supervisor.start()
        try:
            assert self.supervisor.connected.wait(PATIENCE_S)
            with closing(Playing(self.host, self.watch)) as waiter:
                start_ns = self.host.now_ns() + 10_000_000
                self.device.play(self.host, waiter, start_host_ns=start_ns)
            deadline_s = time.monotonic() + PATIENCE_S
            while not self.watch.latencies() and time.monotonic() < deadline_s:
                self.watch.look()
            return self.watch.latencies()["tactile_left"]
        finally:
            self.supervisor.stop()
            self.device.port.unplug()

    def least_delay_ns(self):
        """Injected, and what the host adds at the least."""
        true_ns = dict(zip(self.device.ledger.sequence, self.device.ledger.t_true_ns, strict=True))
        return min(t_ns - true_ns[sequence] for sequence, t_ns in self.arrivals)


def test_sigma_is_honest(capsys):
    rows = []
    for seed in range(6):
        glove = Glove(seed)
        latency = glove.play()
        injected_ms = glove.faults.path_delay_ms
        error_ms = latency.latency_ns * 1e-6 - injected_ms
        host_ms = glove.least_delay_ns() * 1e-6 - injected_ms
        rows.append((error_ms, latency.sigma_ns * 1e-6, host_ms))
        with capsys.disabled():
            sys.stdout.write(
                f"\npath delay {injected_ms:6.2f} ms | error {error_ms:6.3f} ms | sigma "
                f"{rows[-1][1]:.3f} ms | least added by queue and host {host_ms:.3f} ms"
            )
    # The host's own least delay is part of the path that is measured.
    assert all(abs(error) <= 3 * sigma + max(0.0, host) for error, sigma, host in rows)
    assert all(0 < sigma <= 0.6 for _, sigma, _ in rows)
