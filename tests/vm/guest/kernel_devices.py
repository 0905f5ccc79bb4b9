"""Devices of our own on a real kernel: USB gadgets behind a dummy controller, and uhid."""

import fcntl
import os
import select
import struct
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

GADGETS = Path("/sys/kernel/config/usb_gadget")
REPORT_BYTES = 64
# Vendor-defined: input reports 1 and 2 and output report 2, each an id and 63 bytes
# (USB HID 1.11, 6.2.2).
REPORT_DESCRIPTOR = bytes.fromhex(
    "0600ff0901a101"  # usage page, usage, collection
    "1500 26ff00 7508 953f"  # 0 … 255, 8 bits, 63 of them
    "8501 0901 8102"
    "8502 0902 8102 0903 9102"
    "c0"
)  # fmt: skip
_CREATE, _DESTROY, _INPUT, _OUTPUT = 11, 1, 12, 6
_MAX_EVENT_BYTES, _DATA_BYTES = 4380, 4096
_BUS_USB = 3
_VIVID = Path("/sys/bus/platform/drivers/vivid")
# VIDIOC_S_CTRL, and vivid's "Timestamp Source".
_SET_CONTROL, _VIVID_STAMP_POINT = 0xC008561C, 0x00F0F018


class Gadget:
    """A USB device that this kernel plugs into itself.

    Args:
        function: of configfs, such as `hid.usb0` or `acm.usb0`.
        attributes: of the function.
        ids: vendor and product.
        serial_number: as the device says it.
    """

    def __init__(
        self,
        function: str,
        attributes: dict[str, bytes],
        *,
        ids: tuple[int, int],
        serial_number: str,
    ) -> None:
        self.folder = GADGETS / serial_number
        configuration = self.folder / "configs/c.1"
        for folder in (self.folder, self.folder / "strings/0x409", configuration):
            folder.mkdir()
        for name, number in zip(("idVendor", "idProduct"), ids, strict=True):
            (self.folder / name).write_text(f"{number:#06x}")
        (self.folder / "strings/0x409/serialnumber").write_text(serial_number)
        (self.folder / "strings/0x409/manufacturer").write_text("DexTouch")
        (self.folder / "strings/0x409/product").write_text(f"test device {serial_number}")
        self.function = self.folder / "functions" / function
        self.function.mkdir()
        for name, value in attributes.items():
            (self.function / name).write_bytes(value)
        (configuration / function).symlink_to(self.function)

    def plug(self, port: int = 0) -> None:
        """Connect it to a port of the dummy controller."""
        (self.folder / "UDC").write_text(f"dummy_udc.{port}")

    def unplug(self) -> None:
        """Pull it out."""
        (self.folder / "UDC").write_text("\n")

    def remove(self) -> None:
        """Take it away for good."""
        if (self.folder / "UDC").read_text().strip():
            self.unplug()
        configuration = self.folder / "configs/c.1"
        (configuration / self.function.name).unlink()
        for folder in (configuration, self.function, self.folder / "strings/0x409", self.folder):
            folder.rmdir()


def hid_gadget(*, ids: tuple[int, int], serial_number: str) -> Gadget:
    """A HID device with our reports; its own side is `device_node(gadget)`."""
    attributes = {
        "protocol": b"0",
        "subclass": b"0",
        "report_length": str(REPORT_BYTES).encode(),
        "report_desc": REPORT_DESCRIPTOR,
    }
    return Gadget("hid.usb0", attributes, ids=ids, serial_number=serial_number)


def serial_gadget(*, ids: tuple[int, int], serial_number: str) -> Gadget:
    """A serial port (CDC ACM); its own side is `/dev/ttyGS` and the number of the port."""
    return Gadget("acm.usb0", {}, ids=ids, serial_number=serial_number)


def device_node(gadget: Gadget) -> Path:
    """The file by which the device itself sends and receives."""
    if gadget.function.name.startswith("acm"):
        return Path(f"/dev/ttyGS{(gadget.function / 'port_num').read_text().strip()}")
    major, minor = map(int, (gadget.function / "dev").read_text().split(":"))
    for path in Path("/dev").glob("hidg*"):
        number = path.stat().st_rdev
        if (os.major(number), os.minor(number)) == (major, minor):
            return path
    raise FileNotFoundError(f"no hidg node {major}:{minor}")


class UserHid:
    """A HID device by /dev/uhid: any ids, reports without a bus between.

    Args:
        ids: vendor and product.
        serial_number: as the device says it.
        answer: gives the reports that follow one from the host.
    """

    def __init__(
        self,
        *,
        ids: tuple[int, int],
        serial_number: str,
        answer: Callable[[bytes], Iterable[bytes]] | None = None,
    ) -> None:
        self._file = os.open("/dev/uhid", os.O_RDWR)
        self._write(
            _CREATE,
            struct.pack(
                "<128s64s64sHHIIII",
                b"DexTouch test device", b"", serial_number.encode(), len(REPORT_DESCRIPTOR),
                _BUS_USB, *ids, 0, 0,
            ) + REPORT_DESCRIPTOR,
        )  # fmt: skip
        self._ended = threading.Event()
        self._listener = threading.Thread(target=self._listen, args=(answer,), daemon=True)
        if answer is not None:
            self._listener.start()

    def send(self, report: bytes) -> None:
        """One input report."""
        self._write(_INPUT, struct.pack("<H", len(report)) + report)

    def destroy(self) -> None:
        """Pull it out."""
        self._ended.set()
        if self._listener.is_alive():
            self._listener.join()
        self._write(_DESTROY, b"")
        os.close(self._file)

    def _listen(self, answer: Callable[[bytes], Iterable[bytes]]) -> None:
        while not self._ended.is_set():
            if not select.select([self._file], [], [], 0.05)[0]:
                continue
            event = os.read(self._file, _MAX_EVENT_BYTES)
            if struct.unpack_from("<I", event) == (_OUTPUT,):
                data = event[4 : 4 + _DATA_BYTES]
                (num_bytes,) = struct.unpack_from("<H", event, 4 + _DATA_BYTES)
                for report in answer(data[:num_bytes]):
                    self.send(report)

    def _write(self, kind: int, data: bytes) -> None:
        os.write(self._file, struct.pack("<I", kind) + data)


def stamp_camera(path: Path, *, at_start: bool) -> None:
    """Whether vivid stamps images with their start or their end (its own control)."""
    with path.open("rb+", buffering=0) as device:
        control = struct.pack("<Ii", _VIVID_STAMP_POINT, int(at_start))
        fcntl.ioctl(device, _SET_CONTROL, control)


def unplug_camera() -> None:
    """Take the virtual camera from its driver."""
    (_VIVID / "unbind").write_text("vivid.0")


def plug_camera() -> None:
    """Give the virtual camera back to its driver."""
    (_VIVID / "bind").write_text("vivid.0")


def until(told: Callable[[], bool], *, within_s: float, pause: Callable[[float], object]) -> None:
    """Ask again and again; the kernel finishes its devices in its own time.

    Raises:
        TimeoutError: it did not become true.
    """
    deadline = time.monotonic() + within_s
    while not told():
        if time.monotonic() > deadline:
            raise TimeoutError(f"not within {within_s} s")
        pause(0.02)
