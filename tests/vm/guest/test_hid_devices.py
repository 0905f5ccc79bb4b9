"""Trackers on real hidraw nodes, made by uhid and behind a USB gadget."""

import os
from contextlib import contextmanager

import numpy as np
import pytest

from services.acquisition.devices.pose_tracker import PoseTrackerSettings
from tests.vm.guest import kernel_devices, packets
from tests.vm.guest.conftest import (
    MAX_BACK_S,
    MAX_FLAGGED_S,
    PATIENCE_S,
    collect,
    replug_row,
    seconds_until_back,
    seconds_until_refused,
)

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


def test_every_pose_of_a_kernel_device_arrives(tracker, opened, send, measured):
    driver = opened(SETTINGS)
    send(tracker.send, packets.pose_reports(0, 200))
    assert_poses(collect(driver, STREAM, 200), 0)
    assert driver.statistics.lost == 0
    measured("pose tracker, uhid", "200 poses at 100 Hz", "200 right, 0 lost")


def test_the_kernel_drops_the_newest_reports_and_the_sequence_tells(tracker, opened, measured):
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
    measured(
        "pose tracker, uhid",
        "200 reports unread",
        f"{RING} kept, {driver.statistics.lost} counted lost, 0 wrong",
    )


@contextmanager
def device_side(gadget):
    """What sends reports as the gadget itself.

    Closed before the gadget is pulled: Linux 6.1 makes the node anew in place while it is held, and
    breaks down at the close (`list_del corruption` in `cd_forget`).
    """
    node = os.open(kernel_devices.device_node(gadget), os.O_RDWR)
    try:
        yield lambda report: os.write(node, report)
    finally:
        os.close(node)


def pass_poses(gadget, send, driver, first, count):
    """Poses from the gadget's side through the kernel and the driver; all must be right."""
    with device_side(gadget) as write:
        sender = send(write, packets.pose_reports(first, count))
        assert_poses(collect(driver, STREAM, count), first)
        sender.join(PATIENCE_S)


@pytest.mark.parametrize("link", ["hid", "usb"])
def test_a_tracker_on_usb_survives_being_replugged(plug, opened, send, measured, link):
    gadget = plug(kernel_devices.hid_gadget, ids=IDS, serial_number=SERIAL)
    gadget.plug()
    driver = opened(SETTINGS.model_copy(update={"link": link}))
    pass_poses(gadget, send, driver, 0, 100)
    flagged_s = seconds_until_refused(driver, gadget.unplug)
    back_s = seconds_until_back(driver, gadget.plug)
    pass_poses(gadget, send, driver, 150, 50)
    measured(f"pose tracker, USB gadget by {link}", *replug_row(flagged_s, back_s))
    assert flagged_s <= MAX_FLAGGED_S
    assert back_s <= MAX_BACK_S
