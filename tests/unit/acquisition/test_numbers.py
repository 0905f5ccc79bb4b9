"""Streams of numbers from a bridge: what the settings declare, and what is refused."""

import struct

import numpy as np
import pytest
from pydantic import ValidationError

from dextouch.errors import DeviceError
from services.acquisition.clock import StationClock
from services.acquisition.devices import build_drivers
from services.acquisition.drivers.packets import Packet, encode_packet
from services.acquisition.drivers.sdk_link import MAX_CHANNELS
from services.acquisition.settings import AcquisitionSettings

SCALAR = {"kind": "numbers", "port": 1, "stream": "emg", "shape": (2, 3), "unit": "uV"}
POSE = {
    "kind": "numbers",
    "port": 1,
    "stream": "elbow_left",
    "stream_kind": "pose",
    "shape": (7,),
    "unit": "pose_m_wxyz",
    "frame": "world",
}


def driver_of(**device):
    devices = AcquisitionSettings(devices=({"rate_hz": 250, **device},)).devices
    (driver,) = build_drivers(devices, StationClock())
    return driver


def hello(channels):
    return (
        b'{"protocol": "dextouch-bridge", "version": 1, "kind": "numbers", "software": "a test",'
        b'"devices": [{"index": 0, "serial_number": "EMG", "source": "none"}],'
        b'"frame": {"handedness": "right", "axes": ["+x", "+y", "+z"]}, "length_unit": "m",'
        b'"channels": %d}\n' % channels
    )


def packet(values, *, sequence=0, t_ns=5):
    payload = struct.pack(f"<{len(values)}d", *values)
    return encode_packet(b"DXNB", Packet(1, 0, sequence, t_ns, payload))


def test_numbers_become_a_sample_of_the_declared_shape():
    driver = driver_of(**SCALAR, dtype="float32")
    (descriptor,) = driver.descriptors
    assert (descriptor.name, descriptor.kind, descriptor.unit) == ("emg", "scalar", "uV")
    assert descriptor.nominal_rate_hz == 250
    values = [0.5, -1.0, np.nan, np.inf, 4.0, 5.0]
    (sample,) = driver.decoder.decode(hello(6) + packet(values), 9)["emg"]
    assert sample.values.dtype == np.float32
    np.testing.assert_array_equal(sample.values, np.array(values).reshape(2, 3))
    assert (sample.t_host_ns, sample.t_device_ns, sample.sequence) == (9, 5, 0)


def test_another_number_of_channels_is_refused():
    with pytest.raises(DeviceError, match="sends 5 numbers a sample, expected 6"):
        driver_of(**SCALAR).decoder.decode(hello(5), 0)


def test_a_packet_of_another_size_is_refused():
    driver = driver_of(**SCALAR)
    driver.decoder.decode(hello(6), 0)
    assert driver.decoder.decode(packet(range(5)), 1) == {}
    assert driver.statistics.refused == 1


def test_repeated_stamps_are_stale():
    driver = driver_of(**SCALAR)
    driver.decoder.decode(hello(6) + packet(range(6)), 1)
    assert driver.decoder.decode(packet(range(6), sequence=1), 2) == {}
    assert driver.decoder.tracking["stale"] == 1


@pytest.mark.parametrize(
    "values",
    [
        [0, 0, 0, 0, 0, 0, 0],
        [0, 0, 0, 1.1, 0, 0, 0],
        [np.nan, 0, 0, 1, 0, 0, 0],
        [0, 0, 0, np.nan, 0, 0, 0],
        [np.inf, 0, 0, 1, 0, 0, 0],
    ],
)
def test_poses_that_are_none_are_refused(values):
    driver = driver_of(**POSE)
    assert driver.decoder.decode(hello(7) + packet(values), 1) == {}
    assert driver.statistics.refused == 1


def test_a_pose_is_taken_as_it_is():
    values = [1.0, 2.0, 3.0, 0.5, -0.5, 0.5, -0.5]
    (sample,) = driver_of(**POSE).decoder.decode(hello(7) + packet(values), 1)["elbow_left"]
    np.testing.assert_array_equal(sample.values, values)


@pytest.mark.parametrize(
    "change",
    [
        {"shape": ()},
        {"shape": (0,)},
        {"shape": (-2, -3)},
        {"shape": (MAX_CHANNELS + 1,)},
        {"shape": (2**40, 2**40)},
        {"stream_kind": "pose"},
        {"stream_kind": "image"},
        {"stream": "camera_head"},
        {"shape": (7,), "unit": "pose_m_wxyz", "frame": "world"},
        {"link": "usb", "vendor_id": 1, "product_id": 2, "port": None},
        {"port": None},
    ],
)
def test_settings_of_no_stream_are_refused(change):
    with pytest.raises(ValidationError):
        driver_of(**{**SCALAR, **change})


def test_touch_in_kpa_has_the_taxels_of_our_glove():
    touch = {**SCALAR, "stream": "tactile_left", "stream_kind": "tactile", "unit": "kPa"}
    assert driver_of(**{**touch, "shape": (320,)}).descriptors[0].shape == (320,)
    with pytest.raises(ValidationError, match=r"shape: got \(138,\) .* expected \(320,\)"):
        driver_of(**{**touch, "shape": (138,)})


def test_a_pose_names_its_frame():
    with pytest.raises(ValidationError, match="such as 'world'"):
        driver_of(**{**POSE, "frame": None})
