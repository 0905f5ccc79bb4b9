"""compose.devices.yml: which device nodes a station's container may open."""

import os
import shutil
from pathlib import Path

import pytest

from tests.containers.composed import Composed
from tests.containers.engine import ROOT

pytestmark = pytest.mark.containers
GROUP = 44444
HIDRAW = 243
# Their drivers answer ENXIO or ENODEV where no such device is plugged in; the cgroup says EPERM.
OPENED = """
import errno, os, sys
for path in sys.argv[1:]:
    try:
        os.close(os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_NOCTTY))
        print("opened")
    except OSError as error:
        print(errno.errorcode[error.errno])
"""


@pytest.fixture
def nodes():
    """Device nodes of the group below /dev: of a station's kinds, and last another one."""
    folder = Path("/dev") / f"dextouch-test-{os.getpid()}"
    folder.mkdir()
    try:
        paths = []
        for name, major in (
            ("serial", 188),
            ("acm", 166),
            ("hid", HIDRAW),
            ("camera", 81),
            ("fuse", 10),
        ):
            path = folder / name
            os.mknod(path, 0o020660, os.makedev(major, 229))
            path.chmod(0o660)  # whatever the umask
            os.chown(path, 0, GROUP)
            paths.append(str(path))
        yield paths
    finally:
        shutil.rmtree(folder)


def test_the_station_may_open_its_kinds_of_devices_only(engine, built, keys, nodes):
    variables = {
        **keys,
        "DEXTOUCH_ACQUISITION_DEVICES": "[]",
        "DEXTOUCH_HIDRAW_MAJOR": str(HIDRAW),
        "DEXTOUCH_DEVICE_GROUP": str(GROUP),
    }
    paths = (ROOT / "docker-compose.yml", ROOT / "deploy/compose.devices.yml")
    composed = Composed(engine, variables, paths)
    done = composed.run_once("acquisition", "python", "-c", OPENED, *nodes)
    *theirs, other = done.stdout.split()
    assert other == "EPERM"
    assert not {"EPERM", "EACCES"} & set(theirs), done.stdout
