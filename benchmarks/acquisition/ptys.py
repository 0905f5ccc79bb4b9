"""Processor load of eight gloves on pseudo terminals, measured in a separate process.

The simulated gloves run in another process, so that only reading, stamping and decoding are
counted.
"""

import json
import os
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Sequence
from functools import partial

import numpy as np

from dextouch.errors import DeviceError
from services.acquisition.clock import StationClock
from services.acquisition.devices.tactile_glove import MAGIC, TactileGloveDecoder
from services.acquisition.drivers.base import Driver
from services.acquisition.transports import SerialTransport

NUM_STREAMS = 8
RATE_HZ = 60
WARM_UP_S = 0.5
MODULE = "benchmarks.acquisition.ptys"


def run_ptys(seconds: float) -> dict[str, float]:
    """Read eight gloves in a fresh process: `seconds` measured, `cpu_s` of all readers, and so on.

    `packets` are those that arrived in that time, `errors` those of any kind.

    Raises:
        DeviceError: the process failed.
    """
    done = subprocess.run(  # noqa: S603 (this very module)
        [sys.executable, "-m", MODULE, "read", str(seconds)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise DeviceError(f"bench acquisition: reading eight terminals failed: {done.stderr}")
    found: dict[str, float] = json.loads(done.stdout)
    return found


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
    command = [sys.executable, "-m", MODULE, "send", str(seconds + 2 * WARM_UP_S)]
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
    from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet

    rng = np.random.default_rng(0)
    start_s = time.monotonic()
    for tick in range(round(seconds * RATE_HZ)):
        for turn, master in enumerate(masters):
            due_s = start_s + (tick + turn / len(masters)) / RATE_HZ
            time.sleep(max(0.0, due_s - time.monotonic()))
            packet = Packet(VERSION, SOURCES["left"], tick, tick, rng.bytes(720))
            os.write(master, encode_packet(MAGIC, packet))


def _read(driver: Driver, stopping: threading.Event) -> None:
    while not stopping.is_set():
        driver.read()


def _packets(drivers: Sequence[Driver]) -> int:
    return sum(driver.statistics.packets for driver in drivers)


if __name__ == "__main__":
    if sys.argv[1] == "read":
        print(json.dumps(read_all(float(sys.argv[2]))))
    else:
        send_all(float(sys.argv[2]), [int(number) for number in sys.argv[3:]])
