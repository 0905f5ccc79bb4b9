"""A deterministic take: every sample of every stream from its seed and number, and who plays it.

Writers and those who check what they wrote make the same samples independently of each other. No
row is all zero, so a row that was filled in shows.
"""

import heapq
from itertools import count

import numpy as np

from dextouch.episodes import GopEncoder, VideoSettings
from dextouch.images import encode_jpeg
from dextouch.schemas import RecordingAttributes
from dextouch.streams import SampleBatch, StreamDescriptor, encoded_values

HEIGHT, WIDTH, NUM_IMAGES = 240, 320, 96
CAMERAS = ("camera_head", "camera_wrist_left", "camera_wrist_right")
NUMBERS = ("tactile_left", "tactile_right", "wrist_left", "wrist_right")
STREAM_NAMES = (*CAMERAS, *NUMBERS)
RATES_HZ = dict.fromkeys(CAMERAS, 30) | {
    "tactile_left": 60, "tactile_right": 60, "wrist_left": 100, "wrist_right": 100,
}  # fmt: skip
# Any start: stamps of a real station are nanoseconds since it was switched on.
START_NS = 5_000_000_000


def descriptor(name, *, camera_unit="h264"):
    kind, shape, dtype, unit = "pose", (7,), "float64", "pose_m_wxyz"
    if name in CAMERAS:
        kind, shape, dtype, unit = "image", (HEIGHT, WIDTH, 3), "uint8", camera_unit
    elif name.startswith("tactile"):
        kind, shape, dtype, unit = "tactile", (360,), "uint16", "counts"
    return StreamDescriptor(
        name=name, kind=kind, shape=shape, dtype=dtype, unit=unit, nominal_rate_hz=RATES_HZ[name]
    )


def attributes(recording_id, *, camera_unit="h264"):
    return RecordingAttributes(
        recording_id=recording_id,
        task="stand_bottle",
        instruction="stand the bottle up",
        domain="human",
        station="bench",
        streams=tuple(descriptor(name, camera_unit=camera_unit) for name in STREAM_NAMES),
    )


def draw_images():
    """The one set of images: a texture that moves, with noise, uint8 [n, h, w, 3]."""
    rng = np.random.default_rng(12)
    # Blocks of gray: H.264 halves the resolution of colours, which is not what is tested here.
    texture = rng.integers(20, 236, (HEIGHT // 16, WIDTH // 16, 1), dtype=np.uint8)
    texture = texture.repeat(16, axis=0).repeat(16, axis=1).repeat(3, axis=2)
    noise = rng.integers(0, 8, (NUM_IMAGES, HEIGHT, WIDTH, 1), dtype=np.uint8)
    moved = [np.roll(texture, (2 * k, 6 * k), axis=(0, 1)) for k in range(NUM_IMAGES)]
    return np.stack(moved) + noise


def image_number(name, numbers):
    """Which image of the set is image `numbers` of a camera."""
    return (numbers + 31 * CAMERAS.index(name)) % NUM_IMAGES


def stamps_ns(name, first, num_samples):
    numbers = np.arange(first, first + num_samples, dtype=np.int64)
    return START_NS + numbers * 1_000_000_000 // RATES_HZ[name]


def values(name, seed, first, num_samples):
    """Samples of a stream of numbers; no row of them is zero."""
    place = STREAM_NAMES.index(name)
    rows = np.arange(first, first + num_samples, dtype=np.int64)[:, None]
    if name.startswith("tactile"):
        columns = np.arange(360)
        return ((7919 * seed + 104_729 * place + 31 * rows + 17 * columns) % 65_521 + 1).astype(
            "u2"
        )
    return 2.0 + np.sin(seed + place + 0.01 * rows + np.arange(7))


def block(name, seed, first, num_samples, images):
    """Arguments of `EpisodeWriter.append` for consecutive samples."""
    numbers = np.arange(first, first + num_samples, dtype=np.int64)
    if name in CAMERAS:
        what = images[image_number(name, numbers)]
    else:
        what = values(name, seed, first, num_samples)
    return {
        "values": what,
        "t_host_ns": stamps_ns(name, first, num_samples),
        "t_device_ns": 1000 * numbers + seed,
        "sequence": numbers,
    }


def spool_batch(name, seed, first, num_samples, jpegs):
    """The same samples as a batch for a spool, whose cameras speak JPEG."""
    made = block(name, seed, first, num_samples, jpegs)
    what = encoded_values(list(made["values"])) if name in CAMERAS else made["values"]
    return SampleBatch(made["t_host_ns"], made["t_device_ns"], made["sequence"], what)


def encode_jpegs(images):
    encoded = np.empty(len(images), dtype=object)
    encoded[:] = [encode_jpeg(image) for image in images]
    return encoded


def schedule(seconds=None):
    """(due in seconds, stream, number) of every sample in order; for ever without `seconds`."""
    for due_s, name, number in heapq.merge(*map(_dues, STREAM_NAMES)):
        if seconds is not None and due_s >= seconds:
            return
        yield due_s, name, number


def _dues(name):
    return ((k / RATES_HZ[name], name, k) for k in count())


class Expected:
    """What a reader must find, made without the store."""

    def __init__(self, images):
        self._images = images
        self._encoded = {name: _Encoded(name, images) for name in CAMERAS}

    def access_units(self, name, start, stop):
        """x264 with one thread says the same every time, so images are compared bit by bit."""
        return self._encoded[name].first(stop)[start:]

    def check(self, reader, name, seed, start, stop):
        """Samples start … stop−1 of a recording's stream are what was written."""
        made = block(name, seed, start, stop - start, self._images)
        at = made["t_host_ns"]
        read = reader.read(name, *((int(at[0]), int(at[-1]) + 1) if len(at) else (0, 0)))
        for stamp in ("t_host_ns", "t_device_ns", "sequence"):
            np.testing.assert_array_equal(getattr(read, stamp), made[stamp], err_msg=name)
        assert all(row.any() for row in read.values), f"{name}: a row of zeros"
        if name not in CAMERAS:
            np.testing.assert_array_equal(read.values, made["values"], err_msg=name)
            return
        assert reader.encoded_images(name, start, stop) == self.access_units(name, start, stop)
        # The bytes could be right and their decoding wrong.
        error = np.abs(read.values.astype(np.int16) - made["values"]).mean(axis=(1, 2, 3))
        assert (error < MAX_IMAGE_ERROR).all(), f"{name}: images off by {error.max():.1f}"


# Mean over pixels, of 255: between the error of the codec and that of the next image.
MAX_IMAGE_ERROR = 8.0


class _Encoded:
    def __init__(self, name, images):
        self._name, self._images, self._units = name, images, []
        self._encoder = GopEncoder(
            HEIGHT, WIDTH, rate_hz=float(RATES_HZ[name]), settings=VideoSettings()
        )

    def first(self, num_images):
        for number in range(len(self._units), num_images):
            image = self._images[image_number(self._name, np.int64(number))]
            self._units.append(self._encoder.encode(image))
        return self._units[:num_images]
