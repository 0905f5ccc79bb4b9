"""Command `dextouch doctor`: checks what this machine can do and what is missing."""

import ctypes.util
import importlib.metadata
import importlib.util
import os
import platform
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from dextouch.command_line import CommandParser, add_json, write_result
from dextouch.errors import InvalidInputError
from dextouch.free_text import printable
from services.cli.extras import install_hint, missing_package
from services.cli.machine import Finding, Machine

# Distributions that are named otherwise than what they provide.
_DISTRIBUTIONS = {
    "serial": "pyserial",
    "hid": "hidapi",
    "usb": "pyusb",
    "cv2": "opencv-contrib-python-headless",
    "mujoco": "mujoco-core",
    "rerun": "rerun-sdk",
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
    "obstore": "stores in a bucket, s3://…",
    "diffusers": "the full-size world model",
}


def examine() -> list[Finding]:
    """Check Python, packages, disk, devices and optional programs, without changing anything."""
    version = platform.python_version()
    is_supported = (3, 11) <= sys.version_info[:2] <= (3, 13)
    findings = [
        Finding("Python", version, ok=is_supported, do="install Python 3.11, 3.12 or 3.13"),
        Finding("processor cores", str(os.cpu_count())),
    ]
    for package, purpose in _PURPOSES.items():
        findings.append(_package(package, purpose))
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
    what = "settings of dextouch up"
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
        return {}, [Finding(what, error.message, ok=False, do="correct them", required=False)]


def _optional(name: str, purpose: str) -> Finding:
    """A package that only one purpose needs; it is in order to do without."""
    what = f"{name} (optional, {purpose})"
    found = _package(name, purpose)
    return Finding(what, found.found if found.ok else f"no: {found.do}")


def _package(name: str, purpose: str) -> Finding:
    """Whether a package is installed, and its version."""
    what = f"{name} ({purpose})"
    if importlib.util.find_spec(name) is None:
        return Finding(what, "no", ok=False, do=install_hint(name))
    try:
        return Finding(what, importlib.metadata.version(_DISTRIBUTIONS.get(name, name)))
    except importlib.metadata.PackageNotFoundError:
        return Finding(what, "yes")


def _outdated() -> list[Finding]:
    """Installed packages of other versions than dextouch-wm asks for."""
    try:
        from packaging.requirements import Requirement

        asked = importlib.metadata.requires("dextouch-wm") or []
    except (ModuleNotFoundError, importlib.metadata.PackageNotFoundError):
        return []
    wrong = []
    for requirement in map(Requirement, sorted(set(asked))):
        # What is installed counts, whichever extra brought it.
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            continue
        if not requirement.specifier.contains(version, prereleases=True):
            spec = f"{requirement.name}{requirement.specifier}"
            do = f"pip install '{spec}'"
            found = f"{version}, expected {requirement.specifier}"
            wrong.append(Finding(requirement.name, found, ok=False, do=do, required=False))
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
