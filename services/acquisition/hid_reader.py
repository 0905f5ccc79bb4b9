"""Program that reads one HID device and passes its reports on; `HidProcessTransport` starts it.

A thread of a busy station comes too late for the 63 reports that the kernel keeps
(docs/device_packets.md). It imports little, so that it starts in a few hundredths of a second.

Usage: python -m services.acquisition.hid_reader VENDOR_ID PRODUCT_ID [SERIAL_NUMBER]
"""

import contextlib
import os
import signal
import struct
import sys

from services.acquisition.clock import StationClock

REPORT_BYTES = 64
# An idle reader writes an empty record so often, which fails when the station is gone.
IDLE_MS = 100
# Before the bytes of a report: the station's time of its arrival, or GONE, and their number.
RECORD = struct.Struct("<qH")
# That of the station's service (deploy/systemd).
PRIORITY = 10
# The bytes say why the device cannot be read any more.
GONE = -1


def main() -> None:
    """Read until the device or the station is gone; standard output is the pipe to the station."""
    # The station decides when to end; Ctrl-C and the stop of a service reach all its processes.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    # Before ordinary processes, where the system lets users do so (RLIMIT_RTPRIO); it mostly waits.
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
    vendor_id, product_id, *serial_number = sys.argv[1:]
    with contextlib.suppress(BrokenPipeError):
        try:
            _pass_on(int(vendor_id), int(product_id), serial_number[0] if serial_number else None)
        except OSError as error:
            reason = str(error).encode()
            os.write(sys.stdout.fileno(), RECORD.pack(GONE, len(reason)) + reason)


def _pass_on(vendor_id: int, product_id: int, serial_number: str | None) -> None:
    import hidraw

    clock, pipe = StationClock(), sys.stdout.fileno()
    device = hidraw.device()
    device.open(vendor_id, product_id, serial_number)
    report = b""
    while True:
        # The first, empty record says that the device is open.
        os.write(pipe, RECORD.pack(clock.now_ns(), len(report)) + report)
        report = bytes(device.read(REPORT_BYTES, IDLE_MS))


if __name__ == "__main__":
    main()
