"""Kinds of devices by name: ours, and those that other packages bring by their entry points."""

import re
import sys

import pytest

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.serving import load_settings
from services.acquisition.clock import StationClock
from services.acquisition.devices import DeviceKind, build_drivers, device_kind, kind_names
from services.acquisition.settings import AcquisitionSettings

GOOD = """
from typing import Literal

from services.acquisition.devices import DeviceKind, DeviceSettings


class Settings(DeviceSettings):
    kind: Literal["elbow"] = "elbow"
    port: str


def build(settings, clock):
    return settings.port


KIND = DeviceKind(name="elbow", settings=Settings, build=build)
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Installs packages of one module into a folder of their own, as pip would leave them."""

    def install(package, text, *, name="elbow", attribute="KIND"):
        folder = tmp_path / package
        info = folder / f"{package}-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        entry = f"[dextouch.devices]\n{name} = {package}:{attribute}\n"
        (info / "entry_points.txt").write_text(entry)
        (folder / f"{package}.py").write_text(text)
        monkeypatch.syspath_prepend(str(folder))
        imported.append(package)

    imported = []
    yield install
    for package in imported:
        sys.modules.pop(package, None)


OWN_KINDS = [
    "camera",
    "finger_tracker",
    "justfloat_glove",
    "numbers",
    "pose_tracker",
    "robot_state",
    "station_camera",
    "tactile_glove",
    "wuji_glove",
]


def test_every_module_of_a_family_is_a_kind_without_a_table():
    assert kind_names() == OWN_KINDS


@pytest.mark.parametrize("name", OWN_KINDS)
def test_our_own_kinds_come_through_the_same_door(name):
    kind = device_kind(name)
    assert isinstance(kind, DeviceKind)
    assert kind.settings.model_fields["kind"].default == kind.name == name


def test_another_package_brings_a_kind_which_is_loaded_when_it_is_named(install):
    assert "elbow" not in kind_names()
    install("lab_elbow", GOOD)
    assert "elbow" in kind_names()
    AcquisitionSettings(devices=[{"kind": "robot_state", "port": 1}])
    assert "lab_elbow" not in sys.modules
    flags = ["--devices", '[{"kind": "elbow", "port": "/dev/elbow"}]']
    (device,) = load_settings(AcquisitionSettings, flags).devices
    assert (type(device).__name__, device.port) == ("Settings", "/dev/elbow")
    assert AcquisitionSettings(devices=[device]).model_dump()["devices"][0] == {
        "kind": "elbow",
        "port": "/dev/elbow",
    }
    # Its build gives no driver, which is told before anything is opened.
    with pytest.raises(InvalidInputError, match=r"'elbow': build gave str, expected a .*Driver"):
        build_drivers([device], StationClock())


@pytest.mark.parametrize(
    ("device", "told"),
    [
        ({"kind": "elbow"}, r"devices\.0\.port: is not set"),
        (
            {"kind": "elbow", "port": "p", "speed": 1},
            r"devices\.0\.speed: there is no such",
        ),
        ({"kind": "knee"}, r"unknown kind of device 'knee'; valid: camera, elbow, finger_tracker"),
        ({"port": "p"}, "expected a map that names its kind: camera, elbow"),
        ({"kind": "tactile_glove", "side": "up"}, r"devices\.0\.side: got 'up', expected 'left'"),
    ],
)
def test_settings_of_a_device_are_validated_by_its_kind(install, device, told):
    install("lab_elbow", GOOD)
    with pytest.raises(InvalidInputError, match=told):
        load_settings(AcquisitionSettings, ["--devices", str([device]).replace("'", '"')])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("import a_library_that_is_not_here", "got ModuleNotFoundError: No module named 'a_lib"),
        ("KIND =", "got SyntaxError"),
        ("1 / 0", "got ZeroDivisionError"),
        ("", "got AttributeError"),
        ("KIND = 3", "got int, expected a services.acquisition.devices.DeviceKind"),
        (GOOD.replace('name="elbow"', 'name="knee"'), "got a kind named 'knee'"),
        (GOOD + 'object.__setattr__(KIND, "settings", int)', "expected a class derived from Dev"),
        (GOOD.replace('Literal["elbow"] =', "str ="), 'expected kind: Literal."elbow". = "elbow"'),
        (GOOD + 'object.__setattr__(KIND, "build", None)', "got build = None"),
    ],
)
def test_a_broken_package_is_named_with_its_entry_point(install, text, told):
    install("lab_elbow", text)
    with pytest.raises(InvalidInputError, match=told) as raised:
        device_kind("elbow")
    message = raised.value.message
    assert "package lab_elbow (entry point lab_elbow:KIND of group dextouch.devices)" in message
    assert re.search(r"; fix (or uninstall )?package lab_elbow", message)
    # Other devices of the station do not suffer.
    AcquisitionSettings(devices=[{"kind": "robot_state", "port": 1}])


def test_two_packages_of_one_kind_are_refused(install):
    install("lab_elbow", GOOD)
    install("other_elbow", GOOD)
    with pytest.raises(InvalidInputError, match=r"got 2 packages.*lab_elbow.*expected one") as told:
        device_kind("elbow")
    assert "other_elbow" in told.value.message


def test_nobody_takes_the_place_of_a_kind_of_ours(install):
    install("lab_elbow", GOOD, name="tactile_glove")
    with pytest.raises(InvalidInputError, match=r"'tactile_glove'.*dextouch-wm.*lab_elbow"):
        device_kind("tactile_glove")


def test_a_kind_that_nobody_brings_is_unknown():
    with pytest.raises(UnknownNameError, match="valid: camera, finger_tracker, justfloat_glove"):
        device_kind("elbow")


@pytest.mark.parametrize(
    "kind",
    [
        {"kind": "tactile_glove"},
        {"kind": "wuji_glove"},
        {"kind": "justfloat_glove", "num_values": 401, "full_scale": 4095, "rate_hz": 60},
    ],
)
def test_settings_of_a_glove_are_read_again_as_they_are_written(kind):
    told = {"side": "left", "port": "/dev/ttyACM0", **kind}
    settings = AcquisitionSettings(devices=[told])
    assert settings.devices[0].kind == kind["kind"]
    assert AcquisitionSettings(devices=settings.model_dump()["devices"]).devices == settings.devices
    (driver,) = build_drivers(settings.devices, StationClock())
    assert driver.name == "glove_left"
