"""The kernel's virtual camera (vivid) through OpenCV and V4L2."""

from itertools import pairwise

import numpy as np

from services.acquisition.settings import StationCameraSettings
from tests.vm.guest.conftest import collect

SETTINGS = StationCameraSettings(
    stream="camera_head",
    device="/dev/video0",
    fourcc="YUYV",
    height_px=480,
    width_px=640,
    # What it gives at this size.
    rate_hz=25,
    encoding="rgb8",
)


def test_images_of_a_kernel_camera_arrive_with_its_stamps(opened):
    driver = opened(SETTINGS)
    samples = collect(driver, "camera_head", 10)
    assert {sample.values.shape for sample in samples} == {(480, 640, 3)}
    # Its test picture has bars of every colour, and a text that counts.
    assert all(sample.values.std() > 20 for sample in samples)
    assert any((a.values != b.values).any() for a, b in pairwise(samples))
    arrivals = np.diff([sample.t_host_ns for sample in samples])
    assert (arrivals > 0).all()
    stamps = np.array([sample.t_device_ns for sample in samples])
    assert (np.diff(stamps) > 0).all()
    ages_ns = np.array([sample.t_host_ns for sample in samples]) - stamps
    assert (ages_ns >= 0).all()
    assert (ages_ns < 2e9).all()
