"""The real capture class: on a video file that OpenCV wrote, and on a scripted V4L2 backend."""

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from dextouch.errors import DeviceError
from services.acquisition.clock import StationClock
from services.acquisition.devices.station_camera import (
    CapturedImage,
    OpenCvCapture,
    StationCamera,
    StationCameraSettings,
    find_camera,
)


def wanted(**settings):
    known = {"stream": "camera_head", "height_px": 48, "width_px": 64}
    return StationCameraSettings(**known | settings)


REQUEST = wanted()
NUM_IMAGES = 12


def picture(index):
    """Red grows from left to right, blue with the image's number."""
    image = np.zeros((48, 64, 3), np.uint8)
    image[..., 0] = np.linspace(40, 200, 64)
    image[..., 2] = 20 * index
    return image


@pytest.fixture
def video(tmp_path):
    path = str(tmp_path / "video.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 48))
    assert writer.isOpened()
    for index in range(NUM_IMAGES):
        writer.write(cv2.cvtColor(picture(index), cv2.COLOR_RGB2BGR))
    writer.release()
    return path


class FileCapture(OpenCvCapture):
    """A video file in place of a camera: it has no clock, and images as fast as they are read."""

    def wait(self, timeout_s):
        if not self._opened().grab():
            raise DeviceError("no more images")
        return True

    def _connect(self):
        video = cv2.VideoCapture(self._find(), cv2.CAP_FFMPEG)
        self._check(video)
        return video


def opened(source, request=REQUEST, capture=OpenCvCapture):
    link = capture(lambda: source, request)
    link.open()
    return link


def test_a_video_file_comes_back_in_the_right_colours(video):
    capture = opened(video, capture=FileCapture)
    for index in range(NUM_IMAGES):
        assert capture.wait(0.1)
        found = capture.retrieve()
        assert np.abs(found.image.astype(int) - picture(index)).mean() < 4
    with pytest.raises(DeviceError, match="no more images"):
        capture.wait(0.1)
    capture.close()


def test_a_video_file_through_the_driver_has_arrival_stamps_only(video):
    link = FileCapture(lambda: video, REQUEST)
    camera = StationCamera(REQUEST, link=link, clock=StationClock(), max_encode_wait_s=20.0)
    camera.open()
    samples = [camera.read()["camera_head"][0] for _ in range(NUM_IMAGES)]
    with pytest.raises(DeviceError, match="no more images"):
        camera.read()
    camera.close()
    # Places in a file are no times of this host.
    assert {(s.t_device_ns, s.sequence) for s in samples} == {(-1, -1)}
    assert not camera.descriptors[0].capabilities.device_time
    assert camera.quality.num_images == NUM_IMAGES


@pytest.mark.parametrize(
    ("request_", "match"),
    [
        (wanted(width_px=80), "64 by 48 px, expected 80 by 48"),
        (wanted(rate_hz=60.0), "30 images a second, expected 60"),
    ],
)
def test_another_size_or_rate_is_refused(video, request_, match):
    with pytest.raises(DeviceError, match=match):
        opened(video, request_, FileCapture)


def test_an_absent_camera_is_a_device_error(tmp_path):
    with pytest.raises(DeviceError, match="plugged in"):
        opened(str(tmp_path / "video9"))


@pytest.mark.parametrize(
    "wrong",
    [{"height_px": 0}, {"rate_hz": 0.0}, {"fourcc": "MJ"}, {"exposure_ms": 40}],
)
def test_impossible_requests_are_refused(wrong):
    with pytest.raises(ValidationError, match="Camera"):
        wanted(**wrong)


class FakeV4l2:
    """Takes the place of cv2.VideoCapture: properties as asked, images and failures by script."""

    script = ()
    refused = frozenset()
    released = 0

    def __init__(self, source, backend):
        assert backend == cv2.CAP_V4L2
        self.properties = {cv2.CAP_PROP_EXPOSURE: 156.0, cv2.CAP_PROP_POS_MSEC: 1234.567891}
        self.order = []

    def isOpened(self):  # noqa: N802 - OpenCV's name
        return True

    def set(self, name, value):
        self.order.append(name)
        if name in self.refused:
            return False
        self.properties[name] = value
        return True

    def get(self, name):
        return self.properties.get(name, 0.0)

    def retrieve(self):
        step = FakeV4l2.script[0]
        FakeV4l2.script = FakeV4l2.script[1:]
        if isinstance(step, Exception):
            raise step
        return step is not None, step

    def release(self):
        FakeV4l2.released += 1

    @staticmethod
    def waitAny(streams, timeoutNs):  # noqa: N802 - OpenCV's names
        assert timeoutNs == 50_000_000
        step = FakeV4l2.script[0]
        if isinstance(step, tuple):
            FakeV4l2.script = FakeV4l2.script[1:]
            return step
        if isinstance(step, str):
            raise cv2.error(step)
        return True, [0]


@pytest.fixture
def v4l2(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", FakeV4l2)
    monkeypatch.setattr(FakeV4l2, "script", ())
    monkeypatch.setattr(FakeV4l2, "refused", frozenset())
    monkeypatch.setattr(FakeV4l2, "released", 0)
    return FakeV4l2


def test_an_image_with_the_drivers_stamp(v4l2):
    bgr = np.zeros((48, 64, 3), np.uint8)
    bgr[..., 0] = 200
    v4l2.script = (bgr,)
    capture = opened("/dev/video0")
    assert capture.wait(0.05)
    found = capture.retrieve()
    assert isinstance(found, CapturedImage)
    assert found.t_driver_ns == 1_234_567_891
    assert found.image[0, 0].tolist() == [0, 0, 200]


def test_nothing_yet_is_no_image_and_no_error(v4l2):
    v4l2.script = ((False, []),)
    assert opened("/dev/video0").wait(0.05) is False


@pytest.mark.parametrize("step", ["Error is reported for camera stream", (True, [])])
def test_an_unplugged_camera_is_a_device_error(v4l2, step):
    v4l2.script = (step,)
    with pytest.raises(DeviceError, match="unplugged"):
        opened("/dev/video0").wait(0.05)


@pytest.mark.parametrize("step", [None, cv2.error("jpeg"), np.zeros((1, 900), np.uint8)])
def test_a_damaged_image_is_none(v4l2, step):
    v4l2.script = (step,)
    capture = opened("/dev/video0")
    assert capture.wait(0.05)
    assert capture.retrieve() is None


def test_the_pixel_format_is_asked_for_first(v4l2):
    capture = opened("/dev/video0")
    asked = capture._opened().order
    assert asked[0] == cv2.CAP_PROP_FOURCC
    assert asked.index(cv2.CAP_PROP_FRAME_WIDTH) < asked.index(cv2.CAP_PROP_FPS)


def test_exposures_are_in_the_units_of_v4l2(v4l2):
    assert opened("/dev/video0").exposure_ns == 15_600_000
    fixed = wanted(exposure_ms=8)
    capture = opened("/dev/video0", fixed)
    assert capture.exposure_ns == 8_000_000
    assert capture._opened().properties[cv2.CAP_PROP_EXPOSURE] == 80
    assert capture._opened().properties[cv2.CAP_PROP_AUTO_EXPOSURE] == 1


@pytest.mark.parametrize(
    ("refused", "match"),
    [(cv2.CAP_PROP_EXPOSURE, "fixed exposure"), (cv2.CAP_PROP_FOURCC, "pixel format 'MJPG'")],
)
def test_a_camera_that_cannot_is_refused_and_given_back(v4l2, refused, match):
    v4l2.refused = {refused}
    with pytest.raises(DeviceError, match=match):
        opened("/dev/video0", wanted(exposure_ms=8))
    assert v4l2.released == 1


def by_id(folder, *names):
    folder.mkdir()
    for number, name in enumerate(names):
        device = folder.parent / f"video{number}"
        device.touch()
        (folder / f"usb-{name}-video-index0").symlink_to(device)
        (folder / f"usb-{name}-video-index1").symlink_to(device)


def test_a_camera_is_found_by_its_serial_number(tmp_path):
    folder = tmp_path / "by-id"
    by_id(folder, "046d_C920_AB12", "046d_C920_XAB12")
    assert find_camera("AB12", folder) == str(tmp_path / "video0")
    # Plugged in again, the kernel gives it another name.
    (folder / "usb-046d_C920_AB12-video-index0").unlink()
    (folder / "usb-046d_C920_AB12-video-index0").symlink_to(tmp_path / "video1")
    assert find_camera("AB12", folder) == str(tmp_path / "video1")


def test_an_unknown_or_ambiguous_serial_number_names_what_is_there(tmp_path):
    with pytest.raises(DeviceError, match="present: none"):
        find_camera("AB12", tmp_path / "nowhere")
    folder = tmp_path / "by-id"
    by_id(folder, "046d_C920_AB12", "0bda_Cam_AB12")
    with pytest.raises(DeviceError, match="not plugged in; present: usb-046d_C920_AB12, usb-0bda"):
        find_camera("AB1", folder)
    with pytest.raises(DeviceError, match="twice"):
        find_camera("AB12", folder)


def test_a_link_gives_no_bytes_and_opens_anew(v4l2):
    link = OpenCvCapture(lambda: "/dev/video0", wanted(device="/dev/video0"))
    for refused in (link.read, lambda: link.write(b"1"), lambda: link.wait(0.05)):
        with pytest.raises(DeviceError, match="camera /dev/video0: not open"):
            refused()
    link.open()
    for refused in (link.read, lambda: link.write(b"1")):
        with pytest.raises(DeviceError, match=r"camera /dev/video0: (provides|accepts)"):
            refused()
    first = link._opened()
    link.open()
    assert link._opened() is not first
    link.close()
    link.close()
    assert v4l2.released == 2
