"""Command `dextouch doctor`: checks what this machine can do, and says what puts it right."""

import ctypes.util
import importlib.metadata
import importlib.util
import os
import platform
import re
import shutil
import socket
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

from dextouch import __version__
from dextouch.command_line import CommandParser, add_json, write_result
from dextouch.errors import InvalidInputError
from dextouch.free_text import printable
from dextouch.installation import install_command, pip_install
from services.cli.extras import install_hint, missing_package

# Distributions that are named otherwise than what they provide.
_DISTRIBUTIONS = {
    "serial": "pyserial",
    "hid": "hidapi",
    "usb": "pyusb",
    "cv2": "opencv-contrib-python-headless",
    "mujoco": "mujoco-core",
    "rerun": "rerun-sdk",
    "mcap_ros2": "mcap-ros2-support",
}
_PURPOSES = {
    "zstandard": "episodes",
    "av": "video of cameras",
    "serial": "gloves over serial",
    "hid": "trackers over HID",
    "usb": "trackers over USB",
    "cv2": "cameras and calibration",
    "fastapi": "HTTP services",
    "redis": "rollouts kept in Redis",
    "scipy": "alignment",
    "mujoco": "the physics twin",
    "torch": "world model and policies",
    "gymnasium": "the Gymnasium bridge",
}
# Without these everything else works.
_OPTIONAL = {
    "rerun": "shows the .rrd files of the player's command: rerun FILE.rrd",
    "pyarrow": "LeRobot datasets",
    "mcap": "MCAP files",
    "mcap_ros2": "MCAP files of ROS 2",
    "obstore": "stores in a bucket, s3://…",
    "diffusers": "the full-size world model",
    "uvloop": "a faster event loop of the services",
}
# Distributions of OpenCV, which all bring the module `cv2`.
_OPENCV_BUILDS = (
    "opencv-python",
    "opencv-python-headless",
    "opencv-contrib-python",
    "opencv-contrib-python-headless",
)
DEVICE_KINDS: Final = {
    "serial devices": ("ttyACM*", "ttyUSB*"),
    "HID devices": ("hidraw*",),
    "USB devices": ("bus/usb/*/*",),
    "cameras": ("video*",),
}
MAX_LATENCY_TIMER_MS = 1  # the least that FTDI chips take
MIN_MEMORY_BYTES = 2 * 10**9  # chosen: a warning, nothing is refused
NVIDIA, DISPLAY_CLASS = "0x10de", "0x03"
COMMAND_TIMEOUT_S = 5.0  # chosen: for local commands


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
    """The machine that is checked, and the functions that read it; `ports` are of `dextouch up`."""

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
            self._gpu(),
        ]

    def _text(self, path: str | Path) -> str | None:
        """A small file, relative to the root or below it; None where it cannot be read."""
        try:
            return (self.root / path).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return None

    def _devices(self) -> list[Finding]:
        findings, dev = [], self.root / "dev"
        access = (
            'sudo groupadd --force dextouch && sudo usermod -aG dextouch "$USER" && '
            f"sudo install -m 644 {self.rules} /etc/udev/rules.d/ && "
            "sudo udevadm control --reload && sudo udevadm trigger  "
            "# the rules need your serial numbers; log in again for the group"
        )
        for kind, patterns in DEVICE_KINDS.items():
            paths = sorted(path for pattern in patterns for path in dev.glob(pattern))
            names = [str(path.relative_to(dev)) for path in paths]
            closed = [name for name in names if not self.may_open(dev / name)]
            if kind == "USB devices" and names:
                # Access to USB devices by libusb is needed only for those without a driver.
                num_open = len(names) - len(closed)
                found = f"{len(names)}, of which {num_open} may be opened"
                findings.append(_advice(kind, found, "" if num_open else access))
            elif closed:
                findings.append(_advice(kind, f"no access: {', '.join(closed)}", access))
            else:
                findings.append(Finding(kind, ", ".join(names) or "none"))
        return findings

    def _latency_timers(self) -> list[Finding]:
        """FTDI chips hold bytes back for 16 ms unless they are told to send at once."""
        findings = []
        for path in sorted((self.root / "sys/bus/usb-serial/devices").glob("*/latency_timer")):
            name, text = path.parent.name, self._text(path) or ""
            is_short = text.isdecimal() and int(text) <= MAX_LATENCY_TIMER_MS
            do = f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{name}/latency_timer"
            found = f"{text or 'unknown'} ms"
            findings.append(_advice(f"latency timer of {name}", found, "" if is_short else do))
        return findings

    def _clock(self) -> Finding:
        """Whether something keeps the wall clock right, which names and dates the takes."""
        synchronized = self.output_of(
            ["timedatectl", "show", "--property=NTPSynchronized", "--value"]
        )
        tracking = self.output_of(["chronyc", "-n", "tracking"]) or ""
        if (synchronized or "").strip() == "yes" or ": Normal" in tracking:
            return Finding("wall clock", "synchronized")
        known = synchronized is not None or tracking
        found = "not synchronized" if known else "unknown: neither timedatectl nor chronyc answers"
        do = "sudo apt-get install chrony && sudo systemctl enable --now chrony"
        return _advice("wall clock", found, do)

    def _ports(self) -> list[Finding]:
        """Whether `dextouch up` can listen where its settings say; 0 stands for any free port."""
        ports = {name: port for name, port in self.ports.items() if port}
        taken = {name: port for name, port in ports.items() if not self.is_free(port)}
        what = "ports of dextouch up"
        if taken:
            found = "in use: " + ", ".join(f"{port} ({name})" for name, port in taken.items())
            other = " ".join(f"--{name.replace('_', '-')}-port 0" for name in taken)
            return [_advice(what, found, f"dextouch up {other}")]
        return [Finding(what, f"{', '.join(map(str, ports.values()))} are free")] if ports else []

    def _memory(self) -> list[Finding]:
        sizes_kb = _colon_fields(self._text("proc/meminfo") or "")
        if not sizes_kb:
            return []
        free_bytes, all_bytes = (
            1024 * int(sizes_kb.get(name, "0 kB").split()[0])
            for name in ("MemAvailable", "MemTotal")
        )
        found = f"{free_bytes / 1e9:.1f} of {all_bytes / 1e9:.1f} GB"
        is_enough = free_bytes >= MIN_MEMORY_BYTES
        do = "" if is_enough else "ps -eo pid,rss,comm --sort=-rss | head"
        return [_advice("free memory", found, do)]

    def _gpu(self) -> Finding:
        what = "GPU (optional)"
        if self._text("proc/driver/nvidia/version") is not None:
            files = sorted((self.root / "proc/driver/nvidia/gpus").glob("*/information"))
            cards = [_colon_fields(self._text(path) or "") for path in files]
            names = ", ".join(card.get("Model", "GPU") for card in cards if card)
            return Finding(what, names or "NVIDIA driver is loaded")
        num_cards = sum(
            self._text(path) == NVIDIA
            and (self._text(path.parent / "class") or "").startswith(DISPLAY_CLASS)
            for path in (self.root / "sys/bus/pci/devices").glob("*/vendor")
        )
        if num_cards:
            do = "sudo apt-get install nvidia-driver && sudo reboot"
            return _advice(what, f"{num_cards} NVIDIA card without a driver", do)
        return Finding(what, "none: models run on the processor")


def _advice(what: str, found: str, do: str = "") -> Finding:
    """What is not required, and is in order if there is nothing to do."""
    return Finding(what, found, ok=not do, do=do, required=False)


def _colon_fields(text: str) -> Mapping[str, str]:
    """Lines of the form `name: value`."""
    pairs = (line.partition(":") for line in text.splitlines())
    return {name.strip(): value.strip() for name, separator, value in pairs if separator}


def examine() -> list[Finding]:
    """Check Python, packages, disk, devices and optional programs, without changing anything."""
    version = platform.python_version()
    is_supported = (3, 11) <= sys.version_info[:2] <= (3, 13)
    findings = [
        Finding("dextouch-wm", f"{__version__}, extras are added by {install_command('EXTRA')}"),
        Finding("Python", version, ok=is_supported, do="install Python 3.11, 3.12 or 3.13"),
        Finding("processor cores", str(os.cpu_count())),
    ]
    findings += [_package(package, purpose) for package, purpose in _PURPOSES.items()]
    findings += opencv_findings()
    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    redis = shutil.which("redis-server") or "no: rollouts are kept in memory"
    libusb = ctypes.util.find_library("usb-1.0") or "no: trackers by link usb need it"
    findings += [
        Finding("free disk", f"{free_gb:.1f} GB", ok=free_gb > 2, do="free at least 2 GB"),
        Finding("redis-server (optional)", redis),
        Finding("libusb (optional)", libusb),
        *(_optional(package, purpose) for package, purpose in _OPTIONAL.items()),
    ]
    ports, problems = _ports_of_up()
    return [*findings, *_outdated(), *problems, *Machine(ports=ports).examine()]


def _ports_of_up() -> tuple[dict[str, int], list[Finding]]:
    """Ports of `dextouch up` as its settings have them, and what is wrong with the settings."""
    try:
        # It needs the extra `serve`.
        from services.cli.up import ports_of_up

        return ports_of_up(), []
    except ModuleNotFoundError as error:
        refusal = missing_package(error)
        if refusal is None:
            raise
        return {}, [Finding("ports of dextouch up", "unknown: it cannot run", required=False)]
    except InvalidInputError as error:
        return {}, [_advice("settings of dextouch up", error.message, "correct them")]


def opencv_findings() -> list[Finding]:
    """Which build of OpenCV is the module `cv2`, where several distributions bring one.

    They all write the same folder: the one that was installed last is imported, and what removes
    one of them removes files of the others.
    """
    installed = {}
    for name in _OPENCV_BUILDS:
        with suppress(importlib.metadata.PackageNotFoundError):
            installed[name] = importlib.metadata.version(name)
    if not installed:
        return []
    ours = _DISTRIBUTIONS["cv2"]
    kept = f"{ours}=={installed[ours]}" if ours in installed else f"{ours}>=4.14,<5"
    do = pip_install("--force-reinstall", "--no-deps", kept)
    versions = ", ".join(f"{name} {version}" for name, version in installed.items())
    loaded = _loaded_opencv()
    if loaded is None:
        return [_advice("module cv2", f"damaged; {versions} bring it", do)]
    if loaded == (ours, installed.get(ours)):
        also = f"; installed with it: {versions}" if len(installed) > 1 else ""
        return [Finding("module cv2", f"of {ours} {loaded[1]}{also}")]
    found = f"of {loaded[0]} {loaded[1]}; installed: {versions}"
    return [_advice("module cv2", found, do)]


def _loaded_opencv() -> tuple[str, str] | None:
    """Distribution and version that the files of `cv2` are of, as its version.py says."""
    spec = importlib.util.find_spec("cv2")
    if spec is None or spec.origin is None:
        return None
    try:
        text = Path(spec.origin).with_name("version.py").read_text(encoding="utf-8")
    except OSError:
        return None
    version = re.search(r'^opencv_version = "([^"]+)"', text, re.MULTILINE)
    if version is None:
        return None
    contrib = "-contrib" if re.search(r"^contrib = True", text, re.MULTILINE) else ""
    headless = "-headless" if re.search(r"^headless = True", text, re.MULTILINE) else ""
    return f"opencv{contrib}-python{headless}", version[1]


def _optional(name: str, purpose: str) -> Finding:
    what = f"{name} (optional, {purpose})"
    found = _package(name, purpose)
    return Finding(what, found.found if found.ok else f"no: {found.do}")


def _package(name: str, purpose: str) -> Finding:
    what = f"{name} ({purpose})"
    if importlib.util.find_spec(name) is None:
        return Finding(what, "no", ok=False, do=install_hint(name))
    try:
        return Finding(what, importlib.metadata.version(_DISTRIBUTIONS.get(name, name)))
    except importlib.metadata.PackageNotFoundError:
        return Finding(what, "yes")


def _outdated() -> list[Finding]:
    try:
        from packaging.requirements import Requirement

        declared = importlib.metadata.requires("dextouch-wm") or []
    except (ModuleNotFoundError, importlib.metadata.PackageNotFoundError):
        return []
    wrong = []
    for requirement in map(Requirement, sorted(set(declared))):
        # What is installed counts, whichever extra brought it.
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            continue
        if not requirement.specifier.contains(version, prereleases=True):
            spec = f"{requirement.name}{requirement.specifier}"
            do = pip_install(spec)
            found = f"{version}, expected {requirement.specifier}"
            wrong.append(_advice(requirement.name, found, do))
    return wrong


def main(argv: Sequence[str]) -> int:
    """Print the findings; returns 1 if something required is missing."""
    parser = CommandParser(
        prog="dextouch doctor",
        description="Check Python, packages, disk, devices, clock, ports, memory and GPU of this "
        "machine, without changing anything. What is not in order is shown with the command that "
        "puts it right. Exits with status 1 if something required is missing.",
        epilog="example:\n  dextouch doctor --json doctor.json",
    )
    add_json(parser)
    arguments = parser.parse_args(list(argv))
    findings = examine()
    width = max(len(finding.what) for finding in findings)
    for finding in findings:
        mark = "ok     " if finding.ok else "MISSING" if finding.required else "advice "
        hint = f"  → {finding.do}" if not finding.ok and finding.do else ""
        print(f"{mark}  {finding.what:<{width}}  {printable(finding.found)}{printable(hint)}")
    write_result(arguments.json, [asdict(finding) for finding in findings])
    return 0 if all(finding.ok or not finding.required for finding in findings) else 1
