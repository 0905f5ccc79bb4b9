"""The driver on a scripted camera and a clock that only the script moves."""

import time

import numpy as np
import pytest
from pydantic import ValidationError

from dextouch.episodes import is_keyframe
from dextouch.errors import DeviceError, InvalidInputError
from services.acquisition.clock import StationClock, VirtualClock
from services.acquisition.devices import build_drivers
from services.acquisition.devices.station_camera import (
    CapturedImage,
    CaptureLink,
    StationCamera,
    StationCameraSettings,
)
from services.acquisition.drivers import images
from services.acquisition.settings import AcquisitionSettings

MS = 1_000_000
PERIOD = 33 * MS
WANTED = {"stream": "camera_head", "height_px": 32, "width_px": 48, "rate_hz": 1e9 / PERIOD}
LATENCY = 5 * MS


class Clock(VirtualClock):
    """A clock that a test sets."""

    def set_ns(self, t_ns):
        self._now_ns = t_ns


def picture(index):
    image = np.full((32, 48, 3), 100, np.uint8)
    image[index % 32] = 200
    return image


class FakeCapture(CaptureLink):
    """Gives what its camera's script says."""

    def __init__(self, camera):
        super().__init__(address="/dev/video7", serial_number="AB12")
        self.camera = camera

    def _connect(self):
        self.camera.opened += 1
        self.exposure_ns = self.camera.exposure_ns
        return self.camera

    def wait(self, timeout_s):
        step = self.camera.next_step()
        self.camera.clock.set_ns(step["t_ns"])
        if "lost" in step:
            raise DeviceError("camera: unplugged while reading")
        return "image" in step

    def retrieve(self):
        step = self.camera.current
        if step["image"] is None:
            return None
        return CapturedImage(step["image"], step["stamp"])

    def _release(self, handle):
        handle.closed += 1


class FakeCamera:
    """Images, silence and failures, one after the other."""

    def __init__(self, steps, *, exposure_ns=None):
        self.steps, self.exposure_ns = list(steps), exposure_ns
        self.clock, self.current, self.opened, self.closed = Clock(), None, 0, 0

    def next_step(self):
        self.current = self.steps.pop(0)
        return self.current

    def driver(self, **options):
        settings = StationCameraSettings(**{"encoding": "rgb8"} | WANTED | options)
        return StationCamera(
            settings, link=FakeCapture(self), clock=self.clock, max_encode_wait_s=20.0
        )


def image(index, *, stamp="own", pixels=None):
    t_ns = 10**9 + index * PERIOD
    return {
        "t_ns": t_ns + LATENCY,
        "image": picture(index) if pixels is None else pixels,
        "stamp": t_ns if stamp == "own" else stamp,
    }


def silence(t_ms):
    return {"t_ns": 10**9 + t_ms * MS}


def read_all(driver, camera):
    driver.open()
    samples = []
    while camera.steps:
        samples += driver.read().get("camera_head", [])
    driver.close()
    return samples


def test_samples_carry_arrival_and_the_drivers_stamp():
    camera = FakeCamera(image(k) for k in range(5))
    driver = camera.driver()
    samples = read_all(driver, camera)
    assert [s.t_host_ns for s in samples] == [10**9 + k * PERIOD + LATENCY for k in range(5)]
    assert [s.t_device_ns for s in samples] == [10**9 + k * PERIOD for k in range(5)]
    assert [s.sequence for s in samples] == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(samples[3].values, picture(3))
    assert driver.statistics.packets == 5
    (descriptor,) = driver.descriptors
    assert (descriptor.unit, descriptor.shape, descriptor.device) == (
        "rgb8",
        (32, 48, 3),
        "camera_head",
    )
    assert descriptor.capabilities.device_time
    assert descriptor.capabilities.tick_ns == 1000
    assert not descriptor.capabilities.sequence
    assert str(driver.info) == "camera /dev/video7"


def test_a_reader_that_was_held_up_between_two_clocks_moves_no_stamp():
    class HeldUpClock(Clock):
        num_left = 0

        def read_ns(self, clock_id):
            now_ns = super().read_ns(clock_id)
            if clock_id == time.CLOCK_MONOTONIC and self.num_left:
                self.num_left -= 1
                self.set_ns(now_ns + 30 * MS)
            return now_ns

    camera = FakeCamera(image(k) for k in range(2))
    camera.clock = HeldUpClock()
    camera.clock.num_left = 1
    samples = read_all(camera.driver(), camera)
    assert [s.t_device_ns for s in samples] == [10**9, 10**9 + PERIOD]


@pytest.mark.parametrize(("point", "sign"), [("start", 1), ("end", -1)])
def test_the_middle_of_the_exposure(point, sign):
    camera = FakeCamera([image(0), image(1)], exposure_ns=16 * MS)
    driver = camera.driver(stamp_point=point, latency_ms=40, latency_sigma_ms=2)
    samples = read_all(driver, camera)
    assert [s.t_device_ns for s in samples] == [
        10**9 + sign * 8 * MS,
        10**9 + PERIOD + sign * 8 * MS,
    ]
    assert driver.calibration() == {
        "camera_head_latency_ns": ((40e6,),),
        "camera_head_latency_sigma_ns": ((2e6,),),
        "camera_head_exposure_ns": ((16e6,),),
    }


def test_nothing_is_stated_that_is_not_known():
    camera = FakeCamera([image(0)])
    driver = camera.driver()
    read_all(driver, camera)
    assert driver.calibration() == {}


@pytest.mark.parametrize("stamp", [None, 0, 1_234_567, 10**18])
def test_stamps_of_another_clock_are_not_used(stamp):
    camera = FakeCamera(image(k, stamp=stamp) for k in range(12))
    driver = camera.driver()
    samples = read_all(driver, camera)
    assert len(samples) == 12
    assert {(s.t_device_ns, s.sequence) for s in samples} == {(-1, -1)}
    assert not driver.descriptors[0].capabilities.device_time
    assert (driver.statistics.refused, driver.quality.num_gaps) == (0, 0)


def test_an_image_with_an_impossible_stamp_is_left_out():
    bad = [image(1, stamp=None), image(2, stamp=10**18), image(4, stamp=10**9 + PERIOD)]
    camera = FakeCamera([image(0), bad[0], bad[1], image(3), bad[2], image(5)])
    driver = camera.driver()
    assert [s.sequence for s in read_all(driver, camera)] == [0, 3, 5]
    assert driver.statistics.refused == 3


def test_stamps_that_leave_the_clock_degrade_the_stream_and_say_so():
    steps = [image(0), *(image(k, stamp=5) for k in range(1, 11)), image(11, stamp=6)]
    camera = FakeCamera(steps)
    driver = camera.driver()
    driver.open()
    assert driver.read()
    for _ in range(9):
        assert driver.read() == {}
    with pytest.raises(DeviceError, match="not on this host's clock"):
        driver.read()
    driver.close()
    driver.open()
    (sample,) = driver.read()["camera_head"]
    assert sample.t_device_ns == -1
    assert not driver.descriptors[0].capabilities.device_time


def test_only_bad_stamps_in_a_row_degrade_the_stream():
    bad = [image(k, stamp=5) for k in range(1, 7)]
    camera = FakeCamera([image(0), *bad, image(7), *bad, image(14)])
    driver = camera.driver()
    assert [s.sequence for s in read_all(driver, camera)] == [0, 7, 14]
    assert driver.descriptors[0].capabilities.device_time


def test_an_image_is_never_given_twice():
    camera = FakeCamera([image(0), image(1), image(1), image(1), image(2)])
    driver = camera.driver()
    assert [s.sequence for s in read_all(driver, camera)] == [0, 1, 2]
    assert driver.statistics.repeated == 2


def test_images_lost_before_us_are_counted_by_the_stamps():
    camera = FakeCamera(image(k) for k in (0, 1, 5, 6, 8))
    driver = camera.driver()
    assert [s.sequence for s in read_all(driver, camera)] == [0, 1, 5, 6, 8]
    assert driver.statistics.lost == 4
    assert driver.quality.num_gaps == 2
    assert driver.quality.gap


def test_a_damaged_image_is_refused():
    camera = FakeCamera([image(0), image(1) | {"image": None}, image(2)])
    driver = camera.driver()
    assert [s.sequence for s in read_all(driver, camera)] == [0, 2]
    assert driver.statistics.refused == 1


def test_images_of_another_size_are_a_device_error():
    camera = FakeCamera([image(0, pixels=np.zeros((16, 48, 3), np.uint8))])
    driver = camera.driver()
    driver.open()
    with pytest.raises(DeviceError, match="expected"):
        driver.read()


def test_unplug_and_replug():
    lost = {"t_ns": 10**9 + 100 * MS, "lost": True}
    camera = FakeCamera([image(0), image(1), lost, image(60), image(61)])
    driver = camera.driver()
    driver.open()
    before = [driver.read()["camera_head"][0].sequence for _ in range(2)]
    with pytest.raises(DeviceError, match="unplugged"):
        driver.read()
    driver.close()
    driver.open()
    after = [driver.read()["camera_head"][0].sequence for _ in range(2)]
    driver.close()
    assert (before, after) == ([0, 1], [60, 61])
    assert driver.statistics.lost == 58
    assert (camera.opened, camera.closed) == (2, 2)


def test_a_silent_camera_is_lost_within_300_ms_and_its_last_image_not_repeated():
    quiet = [silence(LATENCY // MS + 50 * k) for k in range(1, 8)]
    camera = FakeCamera([image(0), *quiet])
    driver = camera.driver()
    driver.open()
    assert len(driver.read()["camera_head"]) == 1
    assert [driver.read() for _ in range(5)] == [{}] * 5
    with pytest.raises(DeviceError, match="no image for 300 ms"):
        driver.read()


def test_a_reader_that_was_held_up_after_its_wait_takes_no_living_camera_for_lost():
    camera = FakeCamera([image(0), silence(LATENCY // MS + 900), image(27)])
    driver = camera.driver()
    driver.open()
    assert len(driver.read()["camera_head"]) == 1
    assert driver.read() == {}
    assert len(driver.read()["camera_head"]) == 1


def test_the_first_image_may_take_longer():
    start_ms = -(10**3)
    camera = FakeCamera([silence(start_ms + k) for k in (2950, 3000, 3050)])
    camera.clock.set_ns(10**9 + start_ms * MS)
    driver = camera.driver()
    driver.open()
    assert driver.read() == driver.read() == {}
    with pytest.raises(DeviceError, match="no image for 3050 ms"):
        driver.read()


def test_a_take_begins_a_group_of_pictures():
    camera = FakeCamera(image(k) for k in range(20))
    driver = camera.driver(encoding="h264")
    driver.open()
    units = []
    for index in range(20):
        if index == 5:
            assert driver.begin_take() == {}
        units += [s.values.item() for s in driver.read()["camera_head"]]
    driver.close()
    assert [k for k, unit in enumerate(units) if is_keyframe(unit)] == [0, 5, 13]


def test_the_encoder_is_loaded_before_the_first_image(monkeypatch):
    loaded = []
    make = images.episodes.GopEncoder
    monkeypatch.setattr(
        images.episodes,
        "GopEncoder",
        lambda *size, **how: loaded.append(size) or make(*size, **how),
    )
    FakeCamera([]).driver(encoding="h264").open()
    assert len(loaded) == 1


def test_lost_and_reopened_cameras_tear_no_group():
    lost = {"t_ns": 10**9 + 700 * MS, "lost": True}
    camera = FakeCamera([*(image(k) for k in (0, 1, 2, 9, 10)), lost, *map(image, range(40, 50))])
    driver = camera.driver(encoding="h264")
    driver.open()
    units = []
    while camera.steps:
        try:
            units += [s.values.item() for s in driver.read()["camera_head"]]
        except DeviceError:
            driver.close()
            driver.open()
    driver.close()
    assert [k for k, unit in enumerate(units) if is_keyframe(unit)] == [0, 8]


def test_quality_of_a_frozen_camera():
    same = picture(3)
    camera = FakeCamera(image(k, pixels=same) for k in range(6))
    driver = camera.driver()
    read_all(driver, camera)
    assert driver.quality.frozen
    assert driver.quality.num_frozen == 3


DEVICE = {"kind": "station_camera", "stream": "camera_head", "serial_number": "AB12"}


def test_settings_become_a_driver_that_says_what_is_known():
    wanted = DEVICE | {"latency_ms": 35.5, "latency_sigma_ms": 1.5, "exposure_ms": 8}
    settings = AcquisitionSettings(devices=[wanted | {"encoding": "h264"}])
    (driver,) = build_drivers(settings.devices, StationClock())
    assert isinstance(driver, StationCamera)
    assert driver.descriptors[0].unit == "h264"
    assert driver.calibration() == {
        "camera_head_latency_ns": ((35.5e6,),),
        "camera_head_latency_sigma_ns": ((1.5e6,),),
        "camera_head_exposure_ns": ((8e6,),),
    }
    with pytest.raises(DeviceError, match="AB12"):
        driver.open()


def test_settings_that_cannot_be():
    with pytest.raises(ValidationError, match="both or neither"):
        AcquisitionSettings(devices=[DEVICE | {"latency_ms": 30}])
    nameless = AcquisitionSettings(devices=[DEVICE | {"serial_number": None}])
    with pytest.raises(InvalidInputError, match="serial_number or its device"):
        build_drivers(nameless.devices, StationClock())
