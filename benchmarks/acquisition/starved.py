"""Readers of devices in processes of their own: packets lost on a starved computer, and load.

A finger tracker (HID) and a glove (serial line) send at their rates from one process. Another reads
both with our drivers, with other busy threads in it and among busy processes. The load is that of
eight gloves on pseudo terminals, whose packets come from another process, so that only reading,
stamping and decoding are counted.
"""

import contextlib
import json
import os
import resource
import select
import socket
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from dextouch.errors import DeviceError
from dextouch.hands import NUM_KEYPOINTS
from services.acquisition.clock import StationClock
from services.acquisition.devices.finger_tracker import FingerTracker, keypoints_descriptor
from services.acquisition.devices.tactile_glove import MAGIC, TactileGloveDecoder
from services.acquisition.drivers.base import Driver
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.hid_process import HidProcessTransport
from services.acquisition.mocks.replay import ReplayStream
from services.acquisition.mocks.trackers_and_cameras import FingerTrackerSource
from services.acquisition.transports import HidTransport, SerialTransport, UsbAddress, open_hid

Way = Literal["thread", "process"]
Load = Literal["idle", "starved"]
# Busy threads of the reading process, and busy processes beside it.
NUM_BUSY: dict[Load, tuple[int, int]] = {"idle": (0, 0), "starved": (4, 4)}
MODULE = "benchmarks.acquisition.starved"
STAND_IN = Path(__file__).parent / "socket_hid"
FINGERS_HZ = 120
FINGERS_PER_GLOVE = 2
# Room for 63 reports of 64 bytes, as hidraw's ring has (HIDRAW_BUFFER_SIZE is 64, one stays free):
# Linux doubles the number and takes 768 bytes a report (measured; a test counts them).
QUEUE_BYTES = 24_000
MAX_REPORTS = 63
# What opening a device waits for: from now on its reports are queued.
OPENED = b"o"
# Readers that bring nothing for so long have taken in all that was kept for them.
SETTLE_S = 2.0
# A device whose own process was later than that leaves a packet out: real ones send no bursts.
MAX_LATE_S = 0.004
# Above the readers: devices do not depend on the load of the computer.
SENDER_PRIORITY = 50


class SocketHid:
    """A HID device for the stand-in of hidapi; every host that opened it has a queue of its own.

    Args:
        path: of the socket, which is the serial number.
        answer: what the device says to a report of the host.
    """

    def __init__(self, path: str, answer: Callable[[bytes], list[bytes]]) -> None:
        self._answer = answer
        self._hosts: list[socket.socket] = []
        self._listening = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listening.bind(path)
        self._listening.listen()

    def send(self, report: bytes) -> bool:
        """A report to every host; whether the host that came last still had room for it."""
        taken = False
        for host in self._hosts:
            try:
                host.send(report)
                taken = True
            except OSError:  # its queue is full, or it has closed, which `listen` notices
                taken = False
        return taken

    def listen(self, timeout_s: float) -> None:
        """Take in hosts and answer them, for at most this long."""
        ready, _, _ = select.select([self._listening, *self._hosts], [], [], timeout_s)
        for one in ready:
            if one is self._listening:
                host, _ = one.accept()
                host.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, QUEUE_BYTES)
                host.setblocking(False)  # noqa: FBT003 - has no name
                self._hosts.append(host)
                host.send(OPENED)
                continue
            try:
                said = one.recv(64)
            except OSError:
                said = b""
            if not said:
                self._hosts.remove(one)
                one.close()
            for report in self._answer(said) if said else []:
                self.send(report)

    def unplug(self) -> None:
        """Vanish: hosts get errors, and nobody can open it."""
        for one in (*self._hosts, self._listening):
            one.close()
        self._hosts.clear()


def run_starved(load: Load, way: Way, seconds: float) -> dict[str, float]:
    """Read in a fresh process among busy ones: see `read_starved`.

    Raises DeviceError if the process failed.
    """
    num_threads, num_processes = NUM_BUSY[load]
    with contextlib.ExitStack() as stack:
        for _ in range(num_processes):
            busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.enter_context(busy)
            stack.callback(busy.kill)
        return _read_apart("read", way, str(num_threads), str(seconds))


def _read_apart(*words: str) -> dict[str, float]:
    """What a fresh process of this module prints; raises DeviceError if the process failed."""
    done = subprocess.run(  # noqa: S603 - this very module
        [sys.executable, "-m", MODULE, *words], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise DeviceError(f"bench acquisition: reading in a process failed: {done.stderr}")
    found: dict[str, float] = json.loads(done.stdout)
    return found


def read_starved(way: Way, num_threads: int, seconds: float) -> dict[str, float]:
    """Read both devices among busy threads of this process, whose `hidraw` is the stand-in.

    Returns:
        `fingers` and `glove`: lost shares; `sent`: finger packets; `reader_cpu`: share of a core
        that the process of the HID reader took.
    """
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    with tempfile.TemporaryDirectory() as folder, _sending(folder, master, seconds) as sender:
        path = f"{folder}/hid"
        address = UsbAddress(1, 1, path)
        hid = (
            HidProcessTransport(address)
            if way == "process"
            else HidTransport(partial(open_hid, address), address=path)
        )
        clock = StationClock()
        serial = SerialTransport(partial(str, os.ttyname(slave)))
        drivers = [
            Driver("glove", transport=serial, decoder=TactileGloveDecoder("left"), clock=clock),
            FingerTracker("fingers", "left", transport=hid, clock=clock),
        ]
        for driver in drivers:
            driver.open()
        stopping = threading.Event()
        threads = [threading.Thread(target=_read, args=(d, stopping)) for d in drivers]
        threads += [threading.Thread(target=_spin, args=(stopping,)) for _ in range(num_threads)]
        for thread in threads:
            thread.start()
        assert sender.stdout is not None  # noqa: S101 - it is a pipe
        sent = json.loads(sender.stdout.readline())
        _settle(drivers)
        stopping.set()
        for thread in threads:
            thread.join()
        for driver in drivers:
            driver.close()
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
    glove, fingers = (driver.statistics.packets for driver in drivers)
    return {
        "fingers": 1 - fingers / sent["fingers"],
        "glove": 1 - glove / sent["glove"],
        "sent": sent["fingers"],
        "reader_cpu": (used.ru_utime + used.ru_stime) / seconds,
    }


def send_both(path: str, master: int, seconds: float) -> None:
    """Send as the two devices do, from when the tracker is asked for its nodes on."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(SENDER_PRIORITY))
    rng = np.random.default_rng(0)
    points_m = rng.uniform(-0.1, 0.1, (1, NUM_KEYPOINTS, 3))
    stream = ReplayStream(keypoints_descriptor("left"), np.zeros(1, np.int64), points_m)
    source = FingerTrackerSource(stream, side="left", rng=rng)
    requested = threading.Event()

    def answer(report: bytes) -> list[bytes]:
        requested.set()
        return source.answer(report)

    hid = SocketHid(path, answer)
    print("ready", flush=True)
    while not requested.is_set():
        hid.listen(1.0)
    sent = {"fingers": 0, "glove": 0}
    start_s = time.monotonic() + SETTLE_S
    for tick in range(round(seconds * FINGERS_HZ)):
        due_s = start_s + tick / FINGERS_HZ
        while (wait_s := due_s - time.monotonic()) > 0:
            hid.listen(wait_s)
        if time.monotonic() - due_s > MAX_LATE_S:
            continue
        for report in source.units(0, sent["fingers"], tick):
            hid.send(report)
        sent["fingers"] += 1
        if tick % FINGERS_PER_GLOVE == 0:
            packet = Packet(VERSION, SOURCES["left"], sent["glove"], tick, rng.bytes(720))
            with contextlib.suppress(BlockingIOError):
                os.write(master, encode_packet(MAGIC, packet))
            sent["glove"] += 1
    print(json.dumps(sent), flush=True)
    sys.stdin.read()


@contextlib.contextmanager
def _sending(folder: str, master: int, seconds: float) -> Iterator["subprocess.Popen[str]"]:
    """The devices' process, which can be opened now."""
    command = [sys.executable, "-m", MODULE, "send", f"{folder}/hid", str(master), str(seconds)]
    with subprocess.Popen(  # noqa: S603 - this very module
        command, pass_fds=[master], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None  # noqa: S101 - it is a pipe
        process.stdout.readline()
        try:
            yield process
        finally:
            process.kill()


def _settle(drivers: Sequence[Driver]) -> None:
    num_before, since_s = -1, time.monotonic()
    while time.monotonic() < since_s + SETTLE_S:
        time.sleep(SETTLE_S / 20)
        num_packets = sum(driver.statistics.packets for driver in drivers)
        if num_packets != num_before:
            num_before, since_s = num_packets, time.monotonic()


def _read(driver: Driver, stopping: threading.Event) -> None:
    while not stopping.is_set():
        driver.read()


def _spin(stopping: threading.Event) -> None:
    while not stopping.is_set():
        pass


NUM_STREAMS = 8
RATE_HZ = 60
WARM_UP_S = 0.5


def run_ptys(seconds: float) -> dict[str, float]:
    """Read eight gloves in a fresh process: `seconds` measured, `cpu_s` of all readers, and so on.

    `packets` are those that arrived in that time, `errors` those of any kind. Raises DeviceError if
    the process failed.
    """
    return _read_apart("read-all", str(seconds))


def read_all(seconds: float) -> dict[str, float]:
    """Open eight terminals, let another process send on them, and read."""
    pairs = [os.openpty() for _ in range(NUM_STREAMS)]
    for _, slave in pairs:
        tty.setraw(slave)
    drivers = [
        Driver(
            f"glove_{index}",
            transport=SerialTransport(partial(str, os.ttyname(slave))),
            decoder=TactileGloveDecoder("left"),
            clock=StationClock(),
        )
        for index, (_, slave) in enumerate(pairs)
    ]
    for driver in drivers:
        driver.open()
    masters = [master for master, _ in pairs]
    command = [sys.executable, "-m", MODULE, "send-all", str(seconds + 2 * WARM_UP_S)]
    with subprocess.Popen(  # noqa: S603 (this very module)
        [*command, *map(str, masters)], pass_fds=masters
    ) as sender:
        stopping = threading.Event()
        threads = [threading.Thread(target=_read, args=(d, stopping)) for d in drivers]
        for thread in threads:
            thread.start()
        while any(driver.statistics.packets == 0 for driver in drivers):
            if sender.poll() is not None:
                raise DeviceError("bench acquisition: the sending process ended too early")
            time.sleep(0.05)
        before = _packets(drivers)
        cpu_s, start_s = time.process_time(), time.monotonic()
        time.sleep(seconds)
        cpu_s, elapsed_s = time.process_time() - cpu_s, time.monotonic() - start_s
        packets = _packets(drivers) - before
        sender.wait()
        stopping.set()
        for thread in threads:
            thread.join()
    errors = sum(d.statistics.crc_errors + d.statistics.lost for d in drivers)
    for driver in drivers:
        driver.close()
    return {"seconds": elapsed_s, "cpu_s": cpu_s, "packets": packets, "errors": errors}


def send_all(seconds: float, masters: Sequence[int]) -> None:
    """Send a packet on each terminal, sixty times a second, evenly spread."""
    rng = np.random.default_rng(0)
    start_s = time.monotonic()
    for tick in range(round(seconds * RATE_HZ)):
        for turn, master in enumerate(masters):
            due_s = start_s + (tick + turn / len(masters)) / RATE_HZ
            time.sleep(max(0.0, due_s - time.monotonic()))
            packet = Packet(VERSION, SOURCES["left"], tick, tick, rng.bytes(720))
            os.write(master, encode_packet(MAGIC, packet))


def _packets(drivers: Sequence[Driver]) -> int:
    return sum(driver.statistics.packets for driver in drivers)


if __name__ == "__main__":
    sys.path.insert(0, str(STAND_IN))
    mode, *words = sys.argv[1:]
    if mode == "read":
        # The first word is one of the two ways.
        chosen: Way = "process" if words[0] == "process" else "thread"
        print(json.dumps(read_starved(chosen, int(words[1]), float(words[2]))))
    elif mode == "send":
        send_both(words[0], int(words[1]), float(words[2]))
    elif mode == "read-all":
        print(json.dumps(read_all(float(words[0]))))
    else:
        send_all(float(words[0]), [int(number) for number in words[1:]])
