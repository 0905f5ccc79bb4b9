"""Transport of a HID device that a process of its own reads, for stations with real devices."""

import os
import select
import subprocess
import sys
import time
from collections import deque
from functools import partial

from services.acquisition import hid_reader, transports
from services.acquisition.hid_reader import GONE, RECORD

# It takes 0.1 s on an idle computer and seconds on a starved one.
START_TIMEOUT_S = 20.0
# What Linux lets every user have (pipe(7), pipe-max-size): 19 s of a finger tracker's reports.
PIPE_BYTES = 1 << 20
READ_BYTES = 1 << 16


class HidProcessTransport(transports.HidTransport):
    """One HID device that `services.acquisition.hid_reader` reads in a process of its own.

    `read` gives one report, and `arrived_ns` says when the process read it. Writing uses a handle
    of this process; the kernel queues reports for each handle, so that the other one misses none.
    The process is started only for a device that this one could open, and ends at `close`.
    """

    def __init__(self, address: transports.UsbAddress) -> None:
        super().__init__(
            partial(transports.open_hid, address),
            address=str(address),
            serial_number=address.serial_number,
        )
        parts = address.vendor_id, address.product_id, address.serial_number
        self._arguments = [str(part) for part in parts if part is not None]
        self._reader: _Reader | None = None

    @property
    def reader_pid(self) -> int | None:
        """Id of the process that reads; None while closed."""
        return None if self._reader is None else self._reader.pid

    def _connect(self) -> transports.HidDevice:
        device = super()._connect()
        try:
            self._reader = _Reader(self._arguments)
            self._reader.await_start()
        except OSError:
            self._release(device)
            raise
        return device

    def _receive(self, handle: transports.HidDevice) -> bytes:
        assert self._reader is not None  # noqa: S101 - there is one while the device is open
        self.arrived_ns, report = self._reader.take()
        return report

    def _release(self, handle: transports.HidDevice) -> None:
        super()._release(handle)
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.end()


class _Reader:
    """The process and the records in its pipe; every failure is an OSError."""

    def __init__(self, arguments: list[str]) -> None:
        # The process has the same import path as this one.
        path = os.pathsep.join(part for part in sys.path if part)
        self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            [sys.executable, "-m", hid_reader.__name__, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            pipesize=PIPE_BYTES,
            env=os.environ | {"PYTHONPATH": path},
        )
        assert self._process.stdout is not None  # noqa: S101 - it is a pipe
        self._pipe = self._process.stdout.fileno()
        self._poll = select.poll()
        self._poll.register(self._pipe, select.POLLIN)
        self._records: deque[tuple[int, bytes]] = deque()
        self._unparsed = b""

    @property
    def pid(self) -> int:
        return self._process.pid

    def await_start(self) -> None:
        end_s = time.monotonic() + START_TIMEOUT_S
        while self.take()[0] is None:
            if time.monotonic() > end_s:
                raise OSError(f"its reader did not start within {START_TIMEOUT_S:.0f} s")

    def take(self) -> tuple[int | None, bytes]:
        """The oldest record: when it was read, and the report or b""; after 0.1 s (None, b"")."""
        if not self._records and self._poll.poll(transports.READ_TIMEOUT_S * 1e3):
            self._parse(os.read(self._pipe, READ_BYTES))
        if not self._records:
            return None, b""
        arrived_ns, report = self._records.popleft()
        if arrived_ns == GONE:
            raise OSError(report.decode())
        return arrived_ns, report

    def end(self) -> None:
        """Kill the process, which holds nothing that is worth keeping, and wait for its end."""
        with self._process as process:
            process.kill()

    def _parse(self, data: bytes) -> None:
        if not data:
            raise OSError(f"its reader ended with status {self._process.wait()}; see its log")
        data = self._unparsed + data
        start = 0
        while len(data) >= (body := start + RECORD.size):
            arrived_ns, length = RECORD.unpack_from(data, start)
            if len(data) < body + length:
                break
            start = body + length
            self._records.append((arrived_ns, data[body:start]))
        self._unparsed = data[start:]
