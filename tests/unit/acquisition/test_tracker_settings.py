import pytest
from pydantic import ValidationError

from dextouch.errors import DeviceError
from services.acquisition.clock import StationClock
from services.acquisition.devices import build_drivers
from services.acquisition.settings import AcquisitionSettings

IDS = {"vendor_id": 0x28DE, "product_id": 0x2300, "serial_number": "LHR-1"}
LINKS = {
    "hid": {"link": "hid", **IDS},
    "usb": {"link": "usb", **IDS},
    "bridge at a port": {"link": "bridge", "port": 4711, "serial_number": "LHR-1"},
    "bridge at a path": {"link": "bridge", "path": "/run/openvr.sock"},
}
ADDRESSES = {
    "hid": "hid 28de:2300",
    "usb": "usb 28de:2300",
    "bridge at a port": "socket 127.0.0.1:4711",
    "bridge at a path": "socket /run/openvr.sock",
}
DEVICES = (
    {"kind": "pose_tracker", "stream": "wrist_left"},
    {"kind": "finger_tracker", "side": "left"},
)


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device["kind"])
def test_each_link_makes_a_driver(device, link):
    settings = AcquisitionSettings(devices=({**device, **LINKS[link]},))
    (driver,) = build_drivers(settings.devices, StationClock())
    assert str(driver.info) == ADDRESSES[link]
    assert driver.descriptors[0].name in {"wrist_left", "keypoints_left"}


@pytest.mark.parametrize(
    "link",
    [
        {},
        {"link": "usb", "vendor_id": 1},
        {"link": "hid", **IDS, "port": 4711},
        {"link": "bridge"},
        {"link": "bridge", "port": 1, "path": "/run/a"},
        {"link": "bridge", "port": 4711, **IDS},
        {"vendor_id": 0x10000, "product_id": 1},
    ],
)
@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device["kind"])
def test_contradictory_links_are_refused(device, link):
    with pytest.raises(ValidationError):
        AcquisitionSettings(devices=({**device, **link},))


@pytest.mark.parametrize("link", ["bridge at a port", "bridge at a path"])
def test_an_absent_bridge_is_a_device_error(link, tmp_path, unused_tcp_port):
    where = {"path": str(tmp_path / "none.sock")} if "path" in link else {"port": unused_tcp_port}
    device = {**DEVICES[0], "link": "bridge", **where}
    (driver,) = build_drivers(AcquisitionSettings(devices=(device,)).devices, StationClock())
    with pytest.raises(DeviceError, match="cannot be opened"):
        driver.open()
