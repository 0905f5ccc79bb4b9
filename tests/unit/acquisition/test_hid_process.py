"""A HID device that a process of its own reads; the device is a socket with the kernel's queue."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from benchmarks.acquisition.starved import MAX_REPORTS, STAND_IN, SocketHid
from dextouch.errors import DeviceError
from services.acquisition import hid_process
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Decoder, Driver
from services.acquisition.drivers.packets import DecoderStatistics
from services.acquisition.hid_process import HidProcessTransport
from services.acquisition.transports import UsbAddress

PATIENCE_S = 20.0
PERIOD_S = 0.002


class Plugged:
    """A device that a thread of its own answers for."""

    def __init__(self, path):
        self.device = SocketHid(path, lambda report: [report])
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self):
        while not self._stopping.is_set():
            self.device.listen(0.01)

    def unplug(self):
        self._stopping.set()
        self._thread.join()
        self.device.unplug()


@pytest.fixture
def path(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(STAND_IN))
    monkeypatch.delitem(sys.modules, "hidraw", raising=False)
    yield str(tmp_path / "hid")
    sys.modules.pop("hidraw", None)


@pytest.fixture
def plugged(path):
    plugged = Plugged(path)
    yield plugged
    plugged.unplug()


@pytest.fixture
def transport(path):
    transport = HidProcessTransport(UsbAddress(0x1209, 0x0D03, path))
    yield transport
    transport.close()


def report(number):
    return number.to_bytes(64, "little")


def take(transport, count):
    taken, end_s = [], time.monotonic() + PATIENCE_S
    while len(taken) < count:
        assert time.monotonic() < end_s, f"got {len(taken)} of {count} reports"
        if data := transport.read():
            taken.append((transport.arrived_ns, data))
    return taken


def wait_until_gone(pid):
    end_s = time.monotonic() + PATIENCE_S
    while Path(f"/proc/{pid}").exists():
        assert time.monotonic() < end_s, f"process {pid} is still there"
        time.sleep(0.01)


class Stamps(Decoder):
    """Keeps what it is given."""

    descriptors = ()

    def __init__(self):
        self.statistics = DecoderStatistics()
        self.given = []

    def reset(self):
        self.given.clear()

    def decode(self, data, t_host_ns):
        self.given.append((t_host_ns, data))
        return {}


# 100 bytes end within a record.
@pytest.mark.parametrize("read_bytes", [hid_process.READ_BYTES, 100])
def test_reports_keep_their_order_and_times_however_late_they_are_taken(
    plugged, transport, monkeypatch, read_bytes
):
    monkeypatch.setattr(hid_process, "READ_BYTES", read_bytes)
    decoder = Stamps()
    driver = Driver("tracker", transport=transport, decoder=decoder, clock=StationClock())
    driver.open()
    clock, sent_ns = StationClock(), []
    for number in range(5 * MAX_REPORTS):
        sent_ns.append(clock.now_ns())
        while not plugged.device.send(report(number)):
            assert clock.now_ns() < sent_ns[0] + PATIENCE_S * 1e9
            time.sleep(PERIOD_S)
        time.sleep(PERIOD_S)
    end_ns = clock.now_ns()
    # Nobody read before: the kernel keeps 63 of them, the rest waits in the pipe.
    while len(taken := decoder.given) < len(sent_ns):
        assert clock.now_ns() < end_ns + PATIENCE_S * 1e9
        driver.read()
    assert [data for _, data in taken] == [report(number) for number in range(len(sent_ns))]
    arrived_ns = [stamp for stamp, _ in taken]
    assert arrived_ns == sorted(arrived_ns)
    assert all(sent <= arrived for sent, arrived in zip(sent_ns, arrived_ns, strict=True))
    assert arrived_ns[len(sent_ns) // 2] < end_ns
    assert transport.read() == b""


def test_an_idle_device_gives_nothing_and_is_answered_for(plugged, transport):
    transport.open()
    assert [transport.read() for _ in range(5)] == [b""] * 5
    transport.write(report(7))
    assert take(transport, 1)[0][1] == report(7)


def test_what_the_kernel_cannot_keep_is_lost_at_its_end(plugged, transport):
    transport.open()
    os.kill(transport.reader_pid, signal.SIGSTOP)
    kept = [plugged.device.send(report(number)) for number in range(80)]
    os.kill(transport.reader_pid, signal.SIGCONT)
    assert kept == [True] * MAX_REPORTS + [False] * (80 - MAX_REPORTS)
    assert [data for _, data in take(transport, MAX_REPORTS)][-1] == report(MAX_REPORTS - 1)


def test_unplugging_is_loss_after_the_last_report_and_replugging_mends_it(path, transport):
    plugged = Plugged(path)
    transport.open()
    plugged.device.send(report(1))
    pid = transport.reader_pid
    assert take(transport, 1)[0][1] == report(1)
    plugged.unplug()
    with pytest.raises(DeviceError, match="unplugged while reading"):
        take(transport, 1)
    transport.close()
    wait_until_gone(pid)
    Path(path).unlink()
    plugged = Plugged(path)
    transport.open()
    plugged.device.send(report(2))
    assert take(transport, 1)[0][1] == report(2)
    plugged.unplug()


def test_no_process_is_started_for_an_absent_device(transport, monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", None)
    with pytest.raises(DeviceError, match="open failed"):
        transport.open()


def test_a_killed_reader_is_loss_and_is_said(plugged, transport):
    transport.open()
    os.kill(transport.reader_pid, signal.SIGKILL)
    with pytest.raises(DeviceError, match="its reader ended with status -9"):
        take(transport, 1)


def test_the_stop_of_a_service_leaves_the_reader_to_the_station(plugged, transport):
    transport.open()
    for number in (signal.SIGTERM, signal.SIGINT):
        os.kill(transport.reader_pid, number)
    plugged.device.send(report(1))
    assert take(transport, 1)[0][1] == report(1)
    pid = transport.reader_pid
    transport.close()
    assert not Path(f"/proc/{pid}").exists()
    assert transport.reader_pid is None


@pytest.mark.long
def test_a_reader_ends_with_a_station_that_is_killed(plugged, path):
    station = (
        "from services.acquisition.hid_process import *\n"
        f"transport = HidProcessTransport(transports.UsbAddress(1, 1, {path!r}))\n"
        "transport.open()\n"
        "print(transport.reader_pid, flush=True)\n"
        "input()\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(
        [sys.executable, "-c", station],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
    ) as process:
        pid = int(process.stdout.readline())
        process.kill()
    wait_until_gone(pid)
