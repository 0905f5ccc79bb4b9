"""Minutes of a whole two-handed station as a recording of a store, made in pieces.

Motion repeats every minute; noise, jitter and lost samples do not. Images are real JPEG and H.264.
"""

import numpy as np

from dextouch.episodes import GopEncoder, VideoSettings
from dextouch.geometry.rotations import quaternion_from_rotation, rotation_from_vector
from dextouch.images import encode_jpeg
from dextouch.schemas import RecordingAttributes
from dextouch.streams import ClockCapabilities, StreamDescriptor, encoded_values
from dextouch.tactile.layout import expand_taxels
from services.twin.hands import HumanHand
from tests.system.take_source import draw_images

PERIOD_S = 60
START_HOST_NS = 7_000_000_000_000
SKEW = 40e-6
LOST_EVERY = 499
IMAGE_UNITS = {
    "camera_head": "jpeg",
    "camera_wrist_left": "h264",
    "camera_wrist_right": "h264",
}
RATES_HZ = {
    "keypoints_left": 60, "keypoints_right": 60,
    "wrist_left": 60, "wrist_right": 60, "head": 60,
    "tactile_left": 60, "tactile_right": 60,
} | dict.fromkeys(IMAGE_UNITS, 30)  # fmt: skip
K_HEAD = ((300.0, 0.0, 160.0), (0.0, 300.0, 120.0), (0.0, 0.0, 1.0))


def write_long_take(store, recording_id, *, minutes, names=tuple(RATES_HZ)):
    """Write a recording of so many whole minutes."""
    calibration = {"K_head": K_HEAD}
    for side in ("left", "right"):
        calibration[f"tactile_{side}_tare_counts"] = ((120.0,) * 360,)
        calibration[f"tactile_{side}_gain_counts_per_kpa"] = ((40.0,) * 360,)
    attributes = RecordingAttributes(
        recording_id=recording_id,
        task="stand_bottle",
        instruction="stand the bottle up",
        domain="human",
        station="long take",
        started_t_host_ns=START_HOST_NS,
        calibration=calibration,
    )
    images = encode_images()
    with store.writer(kind="recording", attributes=attributes) as writer:
        for number, name in enumerate(names):
            stream = descriptor(name)
            writer.add_stream(stream)
            values = images[stream.unit] if stream.kind == "image" else minute_of(name)
            rng = np.random.default_rng(number)
            for minute in range(minutes):
                append_minute(writer, stream, minute, values, rng)


def descriptor(name):
    kind, shape, dtype, unit = "pose", (7,), "float64", "pose_m_wxyz"
    if name in IMAGE_UNITS:
        kind, shape, dtype, unit = "image", (240, 320, 3), "uint8", IMAGE_UNITS[name]
    elif name.startswith("tactile"):
        kind, shape, dtype, unit = "tactile", (360,), "uint16", "counts"
    elif name.startswith("keypoints"):
        kind, shape, dtype, unit = "keypoints", (25, 3), "float32", "m"
    return StreamDescriptor(
        name=name,
        kind=kind,
        shape=shape,
        dtype=dtype,
        unit=unit,
        nominal_rate_hz=RATES_HZ[name],
        side=next((side for side in ("left", "right") if name.endswith(side)), None),
        capabilities=ClockCapabilities(crc=True, sequence=True, device_time=True),
    )


def minute_of(name):
    """A minute of a stream of numbers, which goes on where it began."""
    t_s = np.arange(PERIOD_S * RATES_HZ[name])[:, None] / RATES_HZ[name]
    rng = np.random.default_rng(len(name) + name.endswith("left"))

    def wave(num):
        turns = rng.integers(12, 50, num)
        return np.sin(2 * np.pi * (turns * t_s / PERIOD_S + rng.random(num)))

    if name.startswith("keypoints"):
        hand = HumanHand(name.removeprefix("keypoints_"))
        middle, half = 0.5 * (hand.lower_rad + hand.upper_rad), hand.upper_rad - hand.lower_rad
        return hand.keypoints_m(middle + 0.25 * half * wave(20)).astype(np.float32)
    if name.startswith("tactile"):
        centre = 160 + 150 * wave(1)
        kpa = 30 * np.maximum(wave(1), 0) * np.exp(-(((np.arange(320) - centre) / 12) ** 2))
        counts = 120 + 40 * expand_taxels(kpa, side=name.removeprefix("tactile_"))
        return np.rint(counts).astype(np.uint16)
    q = quaternion_from_rotation(rotation_from_vector(0.6 * wave(3)))
    return np.concatenate([0.15 * wave(3), q], axis=1)


def append_minute(writer, stream, minute, values, rng):
    num = PERIOD_S * int(stream.nominal_rate_hz)
    numbers = np.arange(minute * num, (minute + 1) * num, dtype=np.int64)
    t_ns = np.rint(numbers * (1e9 / stream.nominal_rate_hz)).astype(np.int64)
    delay_ns = np.rint(2e6 + rng.exponential(0.8e6, num)).astype(np.int64)
    arrival_ns = np.maximum.accumulate(t_ns + delay_ns) + START_HOST_NS
    device_ns = np.rint(t_ns * (1 - SKEW)).astype(np.int64) + 10**12
    # Images of a group of pictures stay together, as a station's encoder leaves them.
    kept = np.ones(num, dtype=bool) if stream.kind == "image" else numbers % LOST_EVERY > 0
    if stream.kind == "image":
        values = values.take(numbers % len(values))
    elif stream.kind == "tactile":
        values = values + rng.integers(0, 4, values.shape, dtype=np.uint16)
    elif stream.kind == "keypoints":
        values = values + rng.normal(scale=3e-4, size=values.shape).astype(np.float32)
    writer.append(
        stream.name,
        values=values[kept],
        t_host_ns=arrival_ns[kept],
        t_device_ns=device_ns[kept],
        sequence=numbers[kept],
    )


def encode_images():
    images = draw_images()
    encoder = GopEncoder(*images.shape[1:3], rate_hz=30.0, settings=VideoSettings())
    return {
        "jpeg": encoded_values([encode_jpeg(image) for image in images]),
        "h264": encoded_values([encoder.encode(image) for image in images]),
    }
