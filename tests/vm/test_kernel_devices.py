"""Boots a Debian kernel and runs the real drivers on real kernel devices in it (`make vm`)."""

import os
import sys
from pathlib import Path

import pytest

from tests.vm.machine import MachineError, fetch_kernel, missing_tools, run_in_machine

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / ".vm"
TIMEOUT_S = 600
# A read that hangs is killed inside, with a trace of where.
HANGS_AFTER_S = 90
MODULES = ("uhid", "usbhid", "hid_generic", "usb_f_hid", "usb_f_acm", "cdc_acm", "vivid")
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


def test_real_drivers_on_real_kernel_devices(kernel, capfd):
    load = [f"modprobe -d $VM_KERNEL {module}" for module in MODULES]
    tests = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
    tests += [
        "-o",
        "addopts=--import-mode=importlib",
        "-o",
        f"faulthandler_timeout={HANGS_AFTER_S}",
    ]
    commands = [
        "modprobe -d $VM_KERNEL dummy_hcd num=2",
        *load,
        "mount -t configfs configfs /sys/kernel/config",
        f"cd {ROOT}",
        " ".join([*tests, "tests/vm/guest"]),
    ]
    environment = {
        "DEXTOUCH_VM_GUEST": "1",
        "TMPDIR": "/mnt",
        "HOME": "/mnt",
        "PATH": os.environ["PATH"],
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        "OMP_NUM_THREADS": "1",
    }
    status, console = run_in_machine(
        commands, folder=FOLDER, timeout_s=TIMEOUT_S, environment=environment
    )
    with capfd.disabled():
        print("\n" + console[console.find("VM_KERNEL") + 1 :])  # noqa: T201
    assert status == 0, console
