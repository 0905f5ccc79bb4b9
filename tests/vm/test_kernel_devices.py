"""Boots a Debian kernel and runs the real drivers on real kernel devices in it (`make vm`)."""

import compileall
import os
import re
import sys
import time
from pathlib import Path

import pytest

from tests.vm.machine import MachineError, fetch_kernel, missing_tools, run_in_machine

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / ".vm"
GUEST = ROOT / "tests/vm/guest"
# Of the host's clock; inside, a test that hangs is ended much earlier (guest/pytest.ini).
TIMEOUT_S = 900
MODULES = ("uhid", "usbhid", "hid_generic", "usb_f_hid", "usb_f_acm", "cdc_acm", "vivid")
# As guest/conftest.py prints them.
ROW = re.compile(r"^VM row: (.+) \| (.+) \| (.+)$", re.MULTILINE)
HEAD = ("device", "what was done", "what came of it")
pytestmark = pytest.mark.vm


@pytest.fixture(scope="module")
def kernel():
    missing = missing_tools()
    if missing:
        pytest.skip(
            f"needs {', '.join(missing)}: apt-get install qemu-system-x86 busybox-static cpio kmod"
        )
    try:
        return fetch_kernel(FOLDER)
    except MachineError as error:
        pytest.skip(f"no Debian kernel to be had: {error}")


def as_table(rows):
    widths = [max(len(row[column]) for row in rows) for column in range(len(HEAD))]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    return "\n".join([lines[0], "-" * len(max(lines, key=len)), *lines[1:]])


def test_real_drivers_on_real_kernel_devices(kernel, capfd):
    # What the machine imports is compiled here once, not there each time.
    for folder in ("shared", "services", "tests/vm"):
        compileall.compile_dir(ROOT / folder, quiet=2)
    tests = [sys.executable, "-m", "pytest", "-v", "--color=no", "-c", GUEST / "pytest.ini"]
    commands = [
        "modprobe -d $VM_KERNEL dummy_hcd num=2",
        *[f"modprobe -d $VM_KERNEL {module}" for module in MODULES],
        "mount -t configfs configfs /sys/kernel/config",
        f"cd {ROOT}",
        " ".join(map(str, [*tests, f"--rootdir={GUEST}", GUEST])),
    ]
    environment = {
        "DEXTOUCH_VM_GUEST": "1",
        "TMPDIR": "/mnt",
        "HOME": "/mnt",
        "PATH": os.environ["PATH"],
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "shared")]),
        "OMP_NUM_THREADS": "1",
    }
    begun = time.monotonic()
    status, console = run_in_machine(
        commands, folder=FOLDER, timeout_s=TIMEOUT_S, environment=environment
    )
    took_s = time.monotonic() - begun
    rows = [tuple(cell.strip() for cell in row) for row in ROW.findall(console)]
    with capfd.disabled():
        print(f"\n{as_table([HEAD, *rows])}\n")  # noqa: T201
        print(f"Linux {kernel.release}; {took_s:.0f} s on this machine; times by the guest's clock")  # noqa: T201
    assert status == 0, console
    assert rows, console
