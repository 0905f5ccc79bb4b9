"""The kernel's virtual camera (vivid) through OpenCV and V4L2."""

from itertools import pairwise
from pathlib import Path

import numpy as np

from dextouch.errors import DeviceError
from dextouch.streams import NO_DEVICE_TIME
from services.acquisition.devices.station_camera import MAX_AHEAD_NS, StationCameraSettings
from tests.vm.guest import kernel_devices
from tests.vm.guest.conftest import (
    MAX_BACK_S,
    MAX_FLAGGED_S,
    collect,
    reopen,
    replug_row,
    seconds_until_back,
    seconds_until_refused,
)

CAMERA = Path("/dev/video0")
SETTINGS = StationCameraSettings(
    stream="camera_head",
    device=str(CAMERA),
    fourcc="YUYV",
    height_px=480,
    width_px=640,
    # What it gives at this size.
    rate_hz=25,
    encoding="rgb8",
)

PIXELS = (480, 640, 3)


def test_images_of_a_kernel_camera_arrive_with_its_stamps(opened, measured):
    kernel_devices.stamp_camera(CAMERA, at_start=True)
    driver = opened(SETTINGS)
    samples = collect(driver, "camera_head", 10)
    assert {sample.values.shape for sample in samples} == {PIXELS}
    # Its test picture has bars of every colour, and a text that counts.
    assert all(sample.values.std() > 20 for sample in samples)
    assert all((a.values != b.values).any() for a, b in pairwise(samples))
    stamps = np.array([sample.t_device_ns for sample in samples])
    assert (np.diff(stamps) > 0).all()
    ages_ns = np.array([sample.t_host_ns for sample in samples]) - stamps
    assert (ages_ns >= 0).all()
    assert driver.descriptors[0].capabilities.device_time
    measured(
        "camera, vivid by V4L2",
        "10 images 640x480 at 25 Hz",
        f"stamped, {ages_ns.min() / 1e6:.1f} to {ages_ns.max() / 1e6:.1f} ms before arrival",
    )


def test_stamps_that_lie_ahead_of_the_clock_are_not_used(opened, measured):
    # Its "end of frame" is its schedule, 36 ms after it handed the image out.
    kernel_devices.stamp_camera(CAMERA, at_start=False)
    driver = opened(SETTINGS)
    samples = []
    # The first image waits while OpenCV makes ready, so its stamp may pass; soon none does.
    for _ in range(20):
        try:
            samples += collect(driver, "camera_head", 1)
        except DeviceError as error:
            if "stamps in a row" not in error.message:
                raise
            reopen(driver)
    kept = [sample for sample in samples if sample.t_device_ns != NO_DEVICE_TIME]
    assert all(sample.t_device_ns <= sample.t_host_ns + MAX_AHEAD_NS for sample in kept)
    assert not driver.descriptors[0].capabilities.device_time
    later = collect(driver, "camera_head", 5)
    assert {sample.t_device_ns for sample in later} == {NO_DEVICE_TIME}
    assert (np.diff([sample.t_host_ns for sample in later]) > 0).all()
    measured("camera, vivid by V4L2", "stamps 35 ms ahead", "arrival stamps only, and said so")


def test_a_camera_survives_being_replugged(opened, measured):
    kernel_devices.stamp_camera(CAMERA, at_start=True)
    driver = opened(SETTINGS)
    collect(driver, "camera_head", 3)

    def plug():
        kernel_devices.plug_camera()
        kernel_devices.stamp_camera(CAMERA, at_start=True)

    flagged_s = seconds_until_refused(driver, kernel_devices.unplug_camera)
    back_s = seconds_until_back(driver, plug)
    samples = collect(driver, "camera_head", 3)
    assert {sample.values.shape for sample in samples} == {PIXELS}
    measured("camera, vivid by V4L2", *replug_row(flagged_s, back_s))
    assert flagged_s <= MAX_FLAGGED_S
    assert back_s <= MAX_BACK_S
