"""What `dextouch doctor` finds in trees of /dev, /proc and /sys that are written down here."""

import json
import socket
from pathlib import Path

import pytest

from services.cli import doctor
from services.cli.doctor import Finding, Machine, is_free

MEMINFO = "MemTotal:       16384000 kB\nMemFree:          200000 kB\nMemAvailable:    8192000 kB\n"
# A service with port 0 takes any free one.
PORTS = {"dashboard": 8080, "episode_store": 8081, "acquisition": 8083, "twin": 0}
ACCESS = (
    'sudo groupadd --force dextouch && sudo usermod -aG dextouch "$USER" && '
    "sudo install -m 644 /opt/60-dextouch.rules /etc/udev/rules.d/ && "
    "sudo udevadm control --reload && sudo udevadm trigger  "
    "# the rules need your serial numbers; log in again for the group"
)
CHRONY = """Reference ID    : C0A80001 (192.168.0.1)
Stratum         : 3
Leap status     : Normal
"""


@pytest.fixture
def tree(tmp_path):
    """Write files below a root."""

    def write(**files):
        for path, text in files.items():
            file = tmp_path / path.replace("__", "/")
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")

    return write


@pytest.fixture
def findings(tmp_path):
    """What is found in the tree, by name."""

    def examine(*, closed=(), taken=(), answers=None, ports=PORTS):
        answers = {"timedatectl": "yes\n"} if answers is None else answers
        machine = Machine(
            root=tmp_path,
            may_open=lambda path: path.name not in closed,
            is_free=lambda port: port not in taken,
            output_of=lambda command: answers.get(command[0]),
            rules=Path("/opt/60-dextouch.rules"),
            ports=ports,
        )
        return {finding.what: finding for finding in machine.examine()}

    return examine


def test_a_machine_in_order(tree, findings):
    tree(dev__ttyACM0="", dev__hidraw3="", proc__meminfo=MEMINFO)
    found = findings()
    assert all(finding.ok and not finding.do for finding in found.values())
    assert found["serial devices"].found == "ttyACM0"
    assert found["cameras"].found == "none"
    assert found["wall clock"].found == "synchronized"
    assert found["free memory"].found == "8.4 of 16.8 GB"
    assert found["ports of dextouch up"].found == "8080, 8081, 8083 are free"
    assert found["GPU (optional)"].found == "none: models run on the processor"


def test_devices_that_may_not_be_opened(tree, findings):
    tree(dev__ttyACM0="", dev__ttyUSB1="", dev__hidraw3="", dev__bus__usb__001__004="")
    found = findings(closed={"ttyUSB1", "004"})
    assert found["serial devices"] == Finding(
        "serial devices", "no access: ttyUSB1", ok=False, do=ACCESS, required=False
    )
    assert found["HID devices"].ok
    assert found["USB devices"].found == "1, of which 0 may be opened"
    assert found["USB devices"].do == ACCESS


def test_a_chip_that_holds_bytes_back_is_told(tmp_path, findings):
    for name, text in {"ttyUSB0": "16\n", "ttyUSB1": "1\n"}.items():
        folder = tmp_path / "sys/bus/usb-serial/devices" / name
        folder.mkdir(parents=True)
        (folder / "latency_timer").write_text(text)
    found = findings()
    assert found["latency timer of ttyUSB0"] == Finding(
        "latency timer of ttyUSB0",
        "16 ms",
        ok=False,
        do="echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer",
        required=False,
    )
    assert found["latency timer of ttyUSB1"].ok


@pytest.mark.parametrize(
    ("answers", "text"),
    [
        ({"timedatectl": "yes\n"}, "synchronized"),
        ({"timedatectl": "no\n", "chronyc": CHRONY}, "synchronized"),
        ({"timedatectl": "no\n"}, "not synchronized"),
        ({"chronyc": CHRONY.replace("Normal", "Not synchronised")}, "not synchronized"),
        ({}, "unknown: neither timedatectl nor chronyc answers"),
    ],
)
def test_the_wall_clock(findings, answers, text):
    clock = findings(answers=answers)["wall clock"]
    assert (clock.found, clock.ok) == (text, text == "synchronized")
    chrony = "sudo apt-get install chrony && sudo systemctl enable --now chrony"
    assert clock.do == ("" if clock.ok else chrony)


def test_ports_in_use(findings):
    ports = findings(taken={8080, 8081})["ports of dextouch up"]
    assert (ports.found, ports.ok) == ("in use: 8080 (dashboard), 8081 (episode_store)", False)
    assert ports.do == "dextouch up --dashboard-port 0 --episode-store-port 0"


@pytest.fixture
def doctors_ports(tmp_path, monkeypatch):
    """What the doctor says of ports, of which those of the settings are in use."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(doctor, "Machine", lambda ports: Machine(root=tmp_path, ports=ports))
    return lambda: {one.what: one for one in doctor.examine()}


def test_the_ports_are_those_of_the_settings_of_up(doctors_ports, tmp_path, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as first, socket.create_server(("", 0)) as second:
        ports = [server.getsockname()[1] for server in (first, second)]
        (tmp_path / "dextouch.toml").write_text(f"[up]\nstudies_port = {ports[0]}\n")
        monkeypatch.setenv("DEXTOUCH_UP_TWIN_PORT", str(ports[1]))
        found = doctors_ports()["ports of dextouch up"]
        assert f"{ports[0]} (studies)" in found.found
        assert f"{ports[1]} (twin)" in found.found
        assert "--studies-port 0" in found.do
        monkeypatch.setenv("DEXTOUCH_UP_WITHOUT", '["twin", "studies"]')
        left = doctors_ports()["ports of dextouch up"].found
        assert "studies" not in left
        assert "twin" not in left


def test_settings_of_up_that_are_wrong_are_a_finding(doctors_ports, monkeypatch):
    monkeypatch.setenv("DEXTOUCH_UP_TWIN_PORT", "far")
    found = doctors_ports()["settings of dextouch up"]
    assert not found.ok
    assert "twin_port: got 'far', expected a whole number" in found.found


def test_what_only_one_purpose_needs_is_listed_with_it(doctors_ports):
    named = [what for what in doctors_ports() if "optional" in what]
    for package, purpose in {
        "rerun": "rerun FILE.rrd",
        "pyarrow": "LeRobot",
        "mcap": "MCAP",
        "obstore": "bucket",
    }.items():
        assert [what for what in named if what.startswith(f"{package} ") and purpose in what]


def test_a_port_that_someone_listens_on_is_not_free():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert not is_free(port)
    assert is_free(port)


def test_little_memory(tree, findings):
    tree(proc__meminfo=MEMINFO.replace("8192000", "1024000"))
    found = findings()
    assert found["free memory"].do == "ps -eo pid,rss,comm --sort=-rss | head"
    assert not found["free memory"].ok


def test_graphics_cards(tmp_path, findings):
    card = tmp_path / "sys/bus/pci/devices/0000:01:00.0"
    card.mkdir(parents=True)
    (card / "vendor").write_text("0x10de\n")
    (card / "class").write_text("0x030200\n")
    found = findings()["GPU (optional)"]
    assert (found.found, found.ok) == ("1 NVIDIA card without a driver", False)
    assert found.do == "sudo apt-get install nvidia-driver && sudo reboot"
    driver = tmp_path / "proc/driver/nvidia/gpus/0000:01:00.0"
    driver.mkdir(parents=True)
    (driver.parents[1] / "version").write_text("NVRM version: NVIDIA UNIX x86_64 580.1\n")
    (driver / "information").write_text("Model: \t\t NVIDIA H100 PCIe\nIRQ: 42\n")
    assert findings()["GPU (optional)"].found == "NVIDIA H100 PCIe"


def test_advice_does_not_fail_the_command(monkeypatch, tmp_path, capsys):
    do = "sudo reboot"
    parts = [Finding("a", "1"), Finding("b", "2", ok=False, do=do, required=False)]
    monkeypatch.setattr(doctor, "examine", lambda: parts)
    assert doctor.main(["--json", str(tmp_path / "doctor.json")]) == 0
    assert "advice   b  2  → sudo reboot" in capsys.readouterr().out
    told = json.loads((tmp_path / "doctor.json").read_text())
    assert [(item["ok"], item["required"], item["do"]) for item in told] == [
        (True, True, ""),
        (False, False, do),
    ]
    parts.append(Finding("c", "no", ok=False, do="pip install c"))
    assert doctor.main([]) == 1


def test_every_finding_that_is_not_in_order_names_a_command():
    assert all(finding.do for finding in doctor.examine() if not finding.ok)


def test_packages_of_another_version_are_told(monkeypatch):
    asked = ["numpy>=2.2", "scipy<1; extra == 'align'", "absent>=1", "dextouch-wm[store]"]
    monkeypatch.setattr(doctor.importlib.metadata, "requires", lambda _: asked)
    versions = {"numpy": "2.3.1", "scipy": "1.17.0"}

    def version(name):
        if name not in versions:
            raise doctor.importlib.metadata.PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(doctor.importlib.metadata, "version", version)
    (wrong,) = doctor._outdated()
    assert (wrong.what, wrong.found) == ("scipy", "1.17.0, expected <1")
    assert wrong.do.endswith("pip install 'scipy<1'")


CV2 = {
    "ours": ('opencv_version = "4.14.0.94"\ncontrib = True\nheadless = True\nrolling = False\n'),
    "lerobot's": 'opencv_version = "4.13.0.92"\ncontrib = False\nheadless = True\n',
}
BOTH = {"opencv-contrib-python-headless": "4.14.0.94", "opencv-python-headless": "4.13.0.92"}


@pytest.fixture
def opencv(tmp_path, monkeypatch):
    """What is found where these distributions are installed, and these files of cv2 are left."""

    def examine(installed, version_file):
        folder = tmp_path / "cv2"
        folder.mkdir(exist_ok=True)
        if version_file is not None:
            (folder / "__init__.py").touch()
            (folder / "version.py").write_text(version_file)
        for name, version in installed.items():
            info = tmp_path / f"{name.replace('-', '_')}-{version}.dist-info"
            info.mkdir()
            (info / "METADATA").write_text(f"Name: {name}\nVersion: {version}\n")
        # Nothing that is really installed.
        monkeypatch.setattr(doctor.sys, "path", [str(tmp_path)])
        monkeypatch.delitem(doctor.sys.modules, "cv2", raising=False)
        doctor.importlib.invalidate_caches()
        return doctor.opencv_findings()

    return examine


def test_the_loaded_opencv_is_named(opencv):
    (found,) = opencv({"opencv-contrib-python-headless": "4.14.0.94"}, CV2["ours"])
    assert (found.found, found.ok) == ("of opencv-contrib-python-headless 4.14.0.94", True)


def test_an_opencv_of_others_over_ours_is_told(opencv):
    (found,) = opencv(BOTH, CV2["lerobot's"])
    assert found.found.startswith("of opencv-python-headless 4.13.0.92; installed: ")
    assert (found.ok, found.required) == (False, False)
    assert found.do.endswith("--no-deps opencv-contrib-python-headless==4.14.0.94")


def test_ours_over_that_of_others_is_in_order(opencv):
    (found,) = opencv(BOTH, CV2["ours"])
    assert found.ok
    assert "opencv-python-headless 4.13.0.92" in found.found


def test_files_that_another_build_took_along_are_missed(opencv):
    (found,) = opencv({"opencv-contrib-python-headless": "4.14.0.94"}, None)
    assert found.found.startswith("damaged")
    assert "pip install --force-reinstall " in found.do


def test_without_opencv_nothing_is_said(opencv):
    assert opencv({}, None) == []
