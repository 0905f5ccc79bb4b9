"""Damaged images at the camera bridge: a decoder would fill them in, so they are refused."""

import io

import numpy as np
import pytest
from PIL import Image

from dextouch.episodes import GopEncoder, VideoSettings
from dextouch.errors import DeviceError
from services.acquisition.devices.camera import (
    ENCODING_CODES,
    MAGIC,
    PAYLOAD_HEADER,
    CameraDecoder,
)
from services.acquisition.drivers.packets import Packet, encode_packet

HEIGHT_PX, WIDTH_PX, GROUP = 96, 128, 8
PERIOD_NS = 33_333_333


def picture(index):
    rows, columns = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    wave = 120 + 60 * np.sin((columns + 4 * index) / 9) * np.cos(rows / 11)
    wave += 30 * ((columns - 3 * index) % 64 < 20)
    return np.repeat(np.clip(wave, 0, 255)[..., None], 3, axis=-1).astype(np.uint8)


@pytest.fixture(scope="module")
def units():
    encoder = GopEncoder(HEIGHT_PX, WIDTH_PX, rate_hz=30.0, settings=VideoSettings())
    return [encoder.encode(picture(index)) for index in range(5 * GROUP)]


def received(bodies, encoding, *, sequence=None):
    """What the driver passes on of images, and how many it refused."""
    decoder = CameraDecoder(
        "camera_head", height_px=HEIGHT_PX, width_px=WIDTH_PX, encoding=encoding
    )
    header = PAYLOAD_HEADER.pack(HEIGHT_PX, WIDTH_PX, ENCODING_CODES[encoding])
    passed = []
    for index, body in enumerate(bodies):
        number = index if sequence is None else sequence[index]
        packet = Packet(1, 0, number, number * PERIOD_NS, header + body)
        passed += decoder.feed(encode_packet(MAGIC, packet), 10**9 + number * PERIOD_NS)
    return [sample.values.item() for sample in passed], decoder.statistics.refused


def without_groups(units, groups):
    return [unit for index, unit in enumerate(units) if index // GROUP not in groups]


@pytest.mark.parametrize("index", [8, 10, 15])
@pytest.mark.parametrize("share", [0.1, 0.6, 0.97])
def test_a_group_with_a_cut_unit_is_refused(units, index, share):
    sent = list(units)
    sent[index] = sent[index][: int(len(sent[index]) * share)]
    assert received(sent, "h264") == (without_groups(units, {1}), GROUP)


def test_a_group_with_scrambled_bytes_is_refused(units):
    noise = np.random.default_rng(0)
    sent = list(units)
    for index in (19, 33):
        start = len(sent[index]) // 2
        damage = noise.integers(1, 255, 40, dtype=np.uint8).tobytes()
        sent[index] = sent[index][:start] + damage + sent[index][start + 40 :]
    assert received(sent, "h264") == (without_groups(units, {2, 4}), 2 * GROUP)


@pytest.mark.parametrize("lost", [8, 11, 15])
@pytest.mark.parametrize("is_numbered", [True, False])
def test_a_group_that_lost_a_unit_is_refused(units, lost, is_numbered):
    """Also where the bridge lost it before it numbered its packets, which then have no gap."""
    kept = [index for index in range(len(units)) if index != lost]
    sent = [units[index] for index in kept]
    passed = received(sent, "h264", sequence=kept if is_numbered else None)
    assert passed == (without_groups(units, {1}), GROUP - 1)


def test_groups_that_are_always_short_are_the_device_s_fault(units):
    short = [units[:GROUP], units[8:15], units[16:23], units[24:25]]
    with pytest.raises(DeviceError, match="another length than 8"):
        received([unit for group in short for unit in group], "h264")


def jpeg(image=None, **options):
    file = io.BytesIO()
    Image.fromarray(picture(3) if image is None else image).save(file, "jpeg", **options)
    return file.getvalue()


WITH_RESTARTS = jpeg(restart_marker_blocks=4)
RESTART = WITH_RESTARTS.find(b"\xff\xd3")
WHOLE = jpeg()


@pytest.mark.parametrize(
    "body",
    [
        WHOLE[: len(WHOLE) * 6 // 10],
        WHOLE[: len(WHOLE) * 6 // 10] + b"\xff\xd9",
        WHOLE[:-2],
        WHOLE[: len(WHOLE) // 2] + WHOLE[len(WHOLE) // 2 + 300 :],
        WITH_RESTARTS[:RESTART] + b"\xff\xd6" + WITH_RESTARTS[RESTART + 2 :],
        WITH_RESTARTS[:RESTART] + WITH_RESTARTS[RESTART + 2 :],
        jpeg(progressive=True)[:-400],
        jpeg(picture(3)[:64]),
        b"\xff\xd8\xff",
    ],
    ids=["cut", "cut and closed", "no end", "hole", "restart", "no restart", "progressive", "size",
         "start only"],
)  # fmt: skip
def test_a_damaged_jpeg_is_refused_alone(body):
    assert received([WHOLE, body, WHOLE], "jpeg") == ([WHOLE, WHOLE], 1)


@pytest.mark.parametrize(
    "body",
    [WITH_RESTARTS, jpeg(progressive=True), jpeg(picture(3)[..., 0]), WHOLE + bytes(37)],
    ids=["restarts", "progressive", "gray", "padded"],
)
def test_other_whole_jpegs_pass(body):
    assert received([body], "jpeg") == ([body], 0)
