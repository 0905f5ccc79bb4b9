"""Checks of the machine for `dextouch doctor`: devices, clock, ports, memory, GPU.

Everything is read below a root folder, so that tests give a tree of their own. Each finding that is
not in order has the command that puts it right.
"""

import os
import shutil
import socket
import subprocess
import sysconfig
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

DEVICE_KINDS: Final = {
    "serial devices": ("ttyACM*", "ttyUSB*"),
    "HID devices": ("hidraw*",),
    "USB devices": ("bus/usb/*/*",),
    "cameras": ("video*",),
}
MAX_LATENCY_TIMER_MS = 1
MIN_MEMORY_BYTES = 2 * 10**9
# Kernels from 5.18 on always show 256.
MIN_ENTROPY_BITS = 128
NVIDIA, DISPLAY_CLASS = "0x10de", "0x03"
COMMAND_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class Finding:
    """Result of one check; what is not `required` is advice alone. `do` is a command."""

    what: str
    found: str
    ok: bool = True
    do: str = ""
    required: bool = True


def output_of(command: Sequence[str]) -> str | None:
    """What a program prints; None where it is missing or fails."""
    if shutil.which(command[0]) is None:
        return None
    try:
        done = subprocess.run(  # noqa: S603 - programs that are named here
            command, capture_output=True, text=True, timeout=COMMAND_TIMEOUT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


def may_open(path: Path) -> bool:
    """Whether this user may read and write a device file."""
    return os.access(path, os.R_OK | os.W_OK)


def is_free(port: int) -> bool:
    """Whether a service could listen on a port of loopback."""
    with socket.socket() as tried:
        # As servers do: a connection that was closed a moment ago is no obstacle.
        tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            tried.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def find_rules() -> Path:
    """The udev rules of this repository, or of the installed package."""
    name = Path("deploy/udev/60-dextouch.rules")
    here = Path(__file__).parents[2] / name
    return here if here.is_file() else Path(sysconfig.get_path("data")) / "share/dextouch" / name


@dataclass(frozen=True)
class Machine:
    """The machine that is checked, and how it is asked.

    Attributes:
        root: of the file system.
        may_open: whether a device file may be opened.
        is_free: whether a port is free.
        output_of: what a program prints, None where it fails.
        rules: the udev rules that give access to devices.
        ports: that `dextouch up` listens on, by service.
    """

    root: Path = Path("/")
    may_open: Callable[[Path], bool] = may_open
    is_free: Callable[[int], bool] = is_free
    output_of: Callable[[Sequence[str]], str | None] = output_of
    rules: Path = field(default_factory=find_rules)
    ports: Mapping[str, int] = field(default_factory=dict)

    def examine(self) -> list[Finding]:
        """All checks, without changing anything."""
        return [
            *self._devices(),
            *self._latency_timers(),
            self._clock(),
            *self._ports(),
            *self._memory(),
            *self._entropy(),
            *self._gpus(),
        ]

    def _text(self, path: str) -> str | None:
        """A small file below the root; None where it cannot be read."""
        try:
            return (self.root / path).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return None

    def _devices(self) -> list[Finding]:
        """Which devices there are, and whether they may be opened."""
        findings, dev = [], self.root / "dev"
        for kind, patterns in DEVICE_KINDS.items():
            paths = sorted(path for pattern in patterns for path in dev.glob(pattern))
            names = [str(path.relative_to(dev)) for path in paths]
            closed = [name for name in names if not self.may_open(dev / name)]
            # Access to USB devices by libusb is needed only for those without a driver.
            is_usb = kind == "USB devices"
            if closed and not is_usb:
                found = f"no access: {', '.join(closed)}"
                findings.append(Finding(kind, found, ok=False, do=self._access(), required=False))
            elif is_usb:
                num_open = len(names) - len(closed)
                found = f"{len(names)}, of which {num_open} may be opened" if names else "none"
                do = self._access() if closed and len(closed) == len(names) else ""
                findings.append(Finding(kind, found, ok=not do, do=do, required=False))
            else:
                findings.append(Finding(kind, ", ".join(names) or "none"))
        return findings

    def _access(self) -> str:
        return (
            f"sudo install -m 644 {self.rules} /etc/udev/rules.d/ && "
            "sudo udevadm control --reload && sudo udevadm trigger"
        )

    def _latency_timers(self) -> list[Finding]:
        """FTDI chips hold bytes back for 16 ms unless they are told to send at once."""
        findings = []
        folder = self.root / "sys/bus/usb-serial/devices"
        for path in sorted(folder.glob("*/latency_timer")):
            name, text = path.parent.name, self._text(str(path.relative_to(self.root))) or ""
            is_short = text.isdecimal() and int(text) <= MAX_LATENCY_TIMER_MS
            do = f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{name}/latency_timer"
            what = f"latency timer of {name}"
            do = "" if is_short else do
            findings.append(
                Finding(what, f"{text or 'unknown'} ms", ok=is_short, do=do, required=False)
            )
        return findings

    def _clock(self) -> Finding:
        """Whether something keeps the wall clock right, which names and dates the takes."""
        shown = self.output_of(["timedatectl", "show", "--property=NTPSynchronized", "--value"])
        tracking = self.output_of(["chronyc", "-n", "tracking"]) or ""
        is_right = (shown or "").strip() == "yes" or ": Normal" in tracking
        what = "wall clock"
        if is_right:
            return Finding(what, "synchronized")
        known = shown is not None or tracking
        found = "not synchronized" if known else "unknown: neither timedatectl nor chronyc answers"
        do = "sudo apt-get install chrony && sudo systemctl enable --now chrony"
        return Finding(what, found, ok=False, do=do, required=False)

    def _ports(self) -> list[Finding]:
        """Whether `dextouch up` can listen where its settings say."""
        # 0 stands for any free one.
        ports = {name: port for name, port in self.ports.items() if port}
        taken = {name: port for name, port in ports.items() if not self.is_free(port)}
        what = "ports of dextouch up"
        if not ports:
            return []
        if not taken:
            return [Finding(what, f"{', '.join(map(str, ports.values()))} are free")]
        found = "in use: " + ", ".join(f"{port} ({name})" for name, port in taken.items())
        other = " ".join(f"--{name.replace('_', '-')}-port 0" for name in taken)
        return [Finding(what, found, ok=False, do=f"dextouch up {other}", required=False)]

    def _memory(self) -> list[Finding]:
        text = self._text("proc/meminfo")
        if text is None:
            return []
        sizes_kb = _colon_fields(text)
        free_bytes = 1024 * int(sizes_kb.get("MemAvailable", "0 kB").split()[0])
        all_bytes = 1024 * int(sizes_kb.get("MemTotal", "0 kB").split()[0])
        found = f"{free_bytes / 1e9:.1f} of {all_bytes / 1e9:.1f} GB"
        is_enough = free_bytes >= MIN_MEMORY_BYTES
        do = "" if is_enough else "ps -eo pid,rss,comm --sort=-rss | head"
        return [Finding("free memory", found, ok=is_enough, do=do, required=False)]

    def _entropy(self) -> list[Finding]:
        """Keys and ids are drawn from the kernel, which must have something to draw from."""
        text = self._text("proc/sys/kernel/random/entropy_avail")
        if text is None or not text.isdecimal():
            return []
        is_enough = int(text) >= MIN_ENTROPY_BITS
        do = "" if is_enough else "sudo apt-get install rng-tools5"
        found = f"{text} bits"
        return [Finding("random numbers of the kernel", found, ok=is_enough, do=do, required=False)]

    def _gpus(self) -> list[Finding]:
        """NVIDIA graphics cards, and whether their driver runs."""
        cards = [
            path.parent
            for path in sorted((self.root / "sys/bus/pci/devices").glob("*/vendor"))
            if self._text(str(path.relative_to(self.root))) == NVIDIA
            and (self._text(str((path.parent / "class").relative_to(self.root))) or "").startswith(
                DISPLAY_CLASS
            )
        ]
        version = self._text("proc/driver/nvidia/version")
        if version is not None:
            names = [
                fields.get("Model", "GPU")
                for path in sorted((self.root / "proc/driver/nvidia/gpus").glob("*/information"))
                if (text := self._text(str(path.relative_to(self.root)))) is not None
                and (fields := _colon_fields(text))
            ]
            return [Finding("GPU (optional)", ", ".join(names) or "NVIDIA driver is loaded")]
        if cards:
            found = f"{len(cards)} NVIDIA card without a driver"
            do = "sudo apt-get install nvidia-driver && sudo reboot"
            return [Finding("GPU (optional)", found, ok=False, do=do, required=False)]
        return [Finding("GPU (optional)", "none: models run on the processor")]


def _colon_fields(text: str) -> Mapping[str, str]:
    """Lines of the form `name: value`."""
    pairs = (line.partition(":") for line in text.splitlines())
    return {name.strip(): value.strip() for name, separator, value in pairs if separator}
