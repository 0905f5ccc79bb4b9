"""Trackers on real hidraw nodes, made by uhid and behind a USB gadget."""

import os

import numpy as np
import pytest

from services.acquisition.settings import PoseTrackerSettings
from tests.vm.guest import kernel_devices, packets
from tests.vm.guest.conftest import collect, reopen, seconds_until_refused

IDS = (0x1209, 0x0D02)
SERIAL = "POSE-17"
STREAM = "wrist_left"
# hidraw's ring of unread reports (HIDRAW_BUFFER_SIZE in the kernel is 64, one place stays free).
RING = 63
SETTINGS = PoseTrackerSettings(
    stream=STREAM, vendor_id=IDS[0], product_id=IDS[1], serial_number=SERIAL
)


@pytest.fixture
def tracker():
    device = kernel_devices.UserHid(ids=IDS, serial_number=SERIAL)
    yield device
    device.destroy()


def assert_poses(samples, first):
    for number, sample in enumerate(samples, start=first):
        assert sample.sequence == number
        assert sample.t_device_ns == number * packets.PERIOD_NS
        np.testing.assert_allclose(sample.values, packets.pose_values(number), atol=1e-6)


def test_every_pose_of_a_kernel_device_arrives(tracker, opened, send):
    driver = opened(SETTINGS)
    send(tracker.send, packets.pose_reports(0, 200))
    assert_poses(collect(driver, STREAM, 200), 0)
    assert driver.statistics.lost == 0


def test_the_kernel_drops_the_newest_reports_and_the_sequence_tells(tracker, opened):
    driver = opened(SETTINGS)
    for report in packets.pose_reports(0, 200):
        tracker.send(report)
    samples = collect(driver, STREAM, RING)
    assert_poses(samples, 0)
    assert driver.read() == {}
    tracker.send(packets.pose_reports(200, 1)[0])
    (sample,) = collect(driver, STREAM, 1)
    assert sample.sequence == 200
    assert driver.statistics.lost == 200 - RING


@pytest.mark.parametrize("link", ["hid", "usb"])
def test_a_tracker_on_usb_survives_being_replugged(plug, opened, send, capsys, link):
    gadget = plug(kernel_devices.hid_gadget, ids=IDS, serial_number=SERIAL)
    gadget.plug()
    driver = opened(SETTINGS.model_copy(update={"link": link}))
    node = os.open(kernel_devices.device_node(gadget), os.O_RDWR)
    try:
        send(lambda report: os.write(node, report), packets.pose_reports(0, 100))
        assert_poses(collect(driver, STREAM, 100), 0)
        gadget.unplug()
        flagged_s = seconds_until_refused(driver)
        gadget.plug()
        back_s = reopen(driver)
        send(lambda report: os.write(node, report), packets.pose_reports(150, 50))
        assert_poses(collect(driver, STREAM, 50), 150)
    finally:
        os.close(node)
    with capsys.disabled():
        print(f"\n{link}: unplug seen after {1e3 * flagged_s:.0f} ms, back after {back_s:.2f} s")  # noqa: T201
    assert flagged_s <= 0.3
    assert back_s <= 2.0
