"""H.264 and image quality over the camera bridge's socket packets."""

import numpy as np
import pytest

from dextouch.episodes import is_keyframe
from dextouch.errors import DeviceError
from dextouch.streams import StreamDescriptor
from services.acquisition.clock import StationClock
from services.acquisition.devices import build_drivers
from services.acquisition.devices.camera import (
    ENCODING_CODES,
    MAGIC,
    PAYLOAD_HEADER,
    CameraDecoder,
)
from services.acquisition.drivers.base import Driver
from services.acquisition.drivers.images import ImageEncoder
from services.acquisition.drivers.packets import Packet, encode_packet
from services.acquisition.mocks.ports import SocketPort
from services.acquisition.mocks.replay import ReplayStream
from services.acquisition.mocks.trackers_and_cameras import CameraSource
from services.acquisition.settings import AcquisitionSettings

PERIOD_NS = 33_333_333


def pictures(count):
    rows, columns = np.mgrid[0:32, 0:48]
    waves = [120 + 60 * np.sin((rows + 2 * k) / 5) + 40 * np.cos(columns / 7) for k in range(count)]
    return np.repeat(np.stack(waves)[..., None], 3, axis=3).astype(np.uint8)


def packets(count, encoding="h264", *, lost=(), images=None, boot_ns=0):
    images = pictures(count) if images is None else images
    descriptor = StreamDescriptor(
        name="camera_head",
        kind="image",
        shape=(32, 48, 3),
        dtype="uint8",
        unit="rgb8",
        nominal_rate_hz=30.0,
    )
    stream = ReplayStream(descriptor, np.arange(count) * PERIOD_NS, images)
    source = CameraSource(stream, encoding=encoding)
    return [
        unit
        for index in range(count)
        if index not in lost
        for unit in source.units(index, 100 + index, boot_ns + index * PERIOD_NS)
    ]


def decoder_of(encoding="h264"):
    return CameraDecoder("camera_head", height_px=32, width_px=48, encoding=encoding)


def decoded(decoder, units):
    samples = []
    for index, unit in enumerate(units):
        samples += decoder.decode(unit, index).get("camera_head", [])
    return samples


def test_h264_passes_through_in_whole_groups():
    decoder = decoder_of()
    samples = decoded(decoder, packets(20))
    assert [s.sequence for s in samples] == list(range(100, 116))
    assert [is_keyframe(s.values.item()) for s in samples] == ([True] + [False] * 7) * 2
    # Each keeps the stamp of its own arrival.
    assert [s.t_host_ns for s in samples] == list(range(16))
    assert decoder.descriptors[0].unit == "h264"
    assert decoder.statistics.refused == 0
    decoder.reset()
    assert decoder.statistics.refused == 4


@pytest.mark.parametrize("lost", [8, 11, 15])
def test_a_torn_group_is_left_out_whole(lost):
    decoder = decoder_of()
    samples = decoded(decoder, packets(24, lost={lost}))
    assert [s.sequence for s in samples] == [*range(100, 108), *range(116, 124)]
    assert decoder.statistics.refused == 7
    assert decoder.statistics.lost == 1


def test_a_group_that_a_lost_link_cut_is_left_out():
    decoder = decoder_of()
    units = packets(24)
    samples = decoded(decoder, units[:11])
    decoder.reset()
    samples += decoded(decoder, units[11:])
    assert [s.sequence for s in samples] == [*range(100, 108), *range(116, 124)]


def bridge_packet(body, sequence, code=ENCODING_CODES["h264"]):
    payload = PAYLOAD_HEADER.pack(32, 48, code) + body
    return encode_packet(MAGIC, Packet(1, 0, sequence, 0, payload))


def test_groups_of_another_length_are_named():
    decoder, encoder = decoder_of(), ImageEncoder("h264", (32, 48), rate_hz=30.0)
    units = [encoder.encode(p, begins=k == 3).item() for k, p in enumerate(pictures(4))]
    decoded(decoder, [bridge_packet(unit, k) for k, unit in enumerate(units[:3])])
    with pytest.raises(DeviceError, match="another length than 8"):
        decoder.decode(bridge_packet(units[3], 3), 3)


def test_bytes_that_are_no_access_unit_are_refused():
    decoder = decoder_of()
    assert decoder.decode(bridge_packet(b"no access unit", 0), 0) == {}
    assert decoder.statistics.refused == 1


def test_the_other_encoding_is_a_device_error():
    with pytest.raises(DeviceError, match="in encoding 2, expected 48 by 32 in 1"):
        decoder_of("jpeg").decode(packets(1)[0], 0)


@pytest.mark.parametrize("encoding", ["rgb8", "jpeg"])
def test_quality_of_a_bridges_images(encoding):
    decoder = decoder_of(encoding)
    driver = Driver(
        "camera_head", transport=SocketPort("c").transport, decoder=decoder, clock=StationClock()
    )
    decoded(decoder, packets(40, encoding))
    assert driver.quality.num_images == 40
    assert driver.quality.num_checked == {"rgb8": 14, "jpeg": 4}[encoding]
    assert not driver.quality.frozen
    still = np.repeat(pictures(1), 5, axis=0)
    decoded(decoder, packets(5, encoding, images=still, boot_ns=10**9))
    assert driver.quality.frozen


def test_a_damaged_jpeg_is_refused():
    decoder = decoder_of("jpeg")
    body = ImageEncoder("jpeg", (32, 48), rate_hz=30.0).encode(pictures(1)[0], begins=False).item()
    assert decoder.decode(bridge_packet(body[:-200], 0, 1), 0) == {}
    assert decoder.statistics.refused == 1
    assert decoder.quality.num_images == 0


def test_settings_of_a_bridge_take_h264():
    wanted = {"kind": "camera", "stream": "camera_head", "port": 5000, "encoding": "h264"}
    (driver,) = build_drivers(AcquisitionSettings(devices=[wanted]).devices, StationClock())
    assert driver.quality is not None
    assert driver.descriptors[0].unit == "h264"
