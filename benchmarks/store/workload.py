"""Workload of the store benchmark: a synthetic take of a whole station."""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64, Shaped, UInt8, UInt16
from scipy.ndimage import gaussian_filter

CAMERAS = ("camera_head", "camera_wrist_left", "camera_wrist_right")
IMAGE_SHAPE = (480, 640, 3)
IMAGE_RATE_HZ = 30
# Of every rival that keeps JPEG.
JPEG_QUALITY = 90
# A window: images of one camera with the touch and the actions of their time.
WINDOW_IMAGES = 17
WINDOW_TACTILE = 34
# Samples of a numeric stream in one second.
NUMERIC_RATES_HZ = {
    "tactile_left": 60,
    "tactile_right": 60,
    "keypoints_left": 120,
    "keypoints_right": 120,
    "wrist_left": 100,
    "wrist_right": 100,
    "head": 100,
    "action": 30,
}


@dataclass(frozen=True)
class TimedStream:
    """One stream: its samples, with strictly increasing timestamps."""

    values: Shaped[np.ndarray, "n ..."]
    t_ref_ns: Int64[np.ndarray, " n"]
    rate_hz: int

    def first(self, seconds: float) -> "TimedStream":
        """The samples of the first seconds."""
        stop = max(1, round(seconds * self.rate_hz))
        return TimedStream(self.values[:stop], self.t_ref_ns[:stop], self.rate_hz)


@dataclass(frozen=True)
class Workload:
    """One take: images uint8 [n, 480, 640, 3] per camera, and the streams of docs/benchmarks.md.

    Sample 2k of a tactile stream, image k and action k belong together: a window that starts at
    image k contains WINDOW_IMAGES images and actions from k on and WINDOW_TACTILE tactile samples
    per hand from 2k on.
    """

    seconds: float
    images: Mapping[str, TimedStream]
    numbers: Mapping[str, TimedStream]

    @property
    def num_images(self) -> int:
        """Images of one camera."""
        return len(self.images[CAMERAS[0]].t_ref_ns)

    @property
    def num_starts(self) -> int:
        """Windows start at 0 … num_starts - 1."""
        return self.num_images - WINDOW_IMAGES + 1

    def arrived_with(self, name: str, image_index: int) -> slice:
        """The samples of a numeric stream that arrive between an image and the one before it."""
        count = len(self.numbers[name].t_ref_ns)
        return slice(
            image_index * count // self.num_images, (image_index + 1) * count // self.num_images
        )

    def first(self, seconds: float) -> "Workload":
        """The first seconds of the take, for warm-up."""
        return Workload(
            seconds,
            {name: stream.first(seconds) for name, stream in self.images.items()},
            {name: stream.first(seconds) for name, stream in self.numbers.items()},
        )


NOISE_SIGMA_LEVELS = 2.0
# Amplitude of the camera motion: small for the head, large for the wrists.
SWING_PX = {"camera_head": 4.0, "camera_wrist_left": 60.0, "camera_wrist_right": 60.0}
_BACKGROUND_PX = (1000, 1300)
_OBJECT_PX = 160
_HAND_PX = (200, 260)
_NUM_OBJECTS = 3
_NUM_CLUTTER = 25
_SKIN = (205.0, 160.0, 135.0)
# Amplitudes fall by 2.2 per octave up to 64 cycles per width: soft colours, no pixel noise.
_SLOPE = 2.14
_CUTOFF_CYCLES = 64.0


@dataclass(frozen=True)
class Scene:
    """Static parts of a camera's view.

    `pairs` holds each pixel of the background with its right neighbour, and an unused fourth
    channel, because numpy gathers rows of 32 bytes fastest. `noise` is as wide as two images, the
    same twice, so that a slice shifts it.
    """

    pairs: Float32[np.ndarray, "1300000 2 4"]
    objects: Float32[np.ndarray, "3 160 160 3"]
    hand: Float32[np.ndarray, "200 260 3"]
    hand_alpha: Float32[np.ndarray, "200 260 1"]
    noise: Float32[np.ndarray, "4 480 1280 3"]
    camera: str


def make_scene(camera: str, rng: np.random.Generator) -> Scene:
    """A table with clutter, three objects, a hand, and the noise of the sensor."""
    background = _texture(rng, *_BACKGROUND_PX)
    for _ in range(_NUM_CLUTTER):
        _draw_box(background, rng)
        _draw_word(background, rng)
    pixels = np.zeros((_BACKGROUND_PX[0] * _BACKGROUND_PX[1], 4), dtype=np.float32)
    pixels[:, :3] = background.reshape(-1, 3)
    grain = rng.normal(0.0, 6.0, size=(*_HAND_PX, 1)).astype(np.float32)
    noise = rng.standard_normal((4, *IMAGE_SHAPE), dtype=np.float32)
    return Scene(
        pairs=np.stack([pixels, np.roll(pixels, -1, axis=0)], axis=1),
        objects=np.stack([_texture(rng, _OBJECT_PX, _OBJECT_PX) for _ in range(_NUM_OBJECTS)]),
        hand=np.array(_SKIN, dtype=np.float32) + grain,
        hand_alpha=_hand_alpha()[..., None],
        noise=np.tile(noise * np.float32(NOISE_SIGMA_LEVELS), (1, 1, 2, 1)),
        camera=camera,
    )


def render(
    scene: Scene, num_images: int, rng: np.random.Generator
) -> UInt8[np.ndarray, "n 480 640 3"]:
    """The images of a camera, the first at time 0, at 30 Hz."""
    images = np.empty((num_images, *IMAGE_SHAPE), dtype=np.uint8)
    for index in range(num_images):
        view = _view(scene, index / IMAGE_RATE_HZ)
        shift = int(rng.integers(IMAGE_SHAPE[1]))
        view += scene.noise[int(rng.integers(len(scene.noise))), :, shift : shift + IMAGE_SHAPE[1]]
        np.clip(view, 0.0, 255.0, out=view)
        images[index] = view
    return images


def _view(scene: Scene, t_s: float) -> Float32[np.ndarray, "480 640 3"]:
    """The scene at a time, before noise: moving background, objects and hand over it."""
    phase = CAMERAS.index(scene.camera)
    view = _background(scene, t_s, phase)
    for index, texture in enumerate(scene.objects):
        x = int(240 + 170 * np.sin(0.9 * t_s + 2 * index))
        y = int(160 + 120 * np.cos(1.3 * t_s + index))
        view[y : y + _OBJECT_PX, x : x + _OBJECT_PX] = texture
    x, y = int(190 + 160 * np.sin(1.7 * t_s)), int(200 + 70 * np.sin(2.3 * t_s + phase))
    below = view[y : y + _HAND_PX[0], x : x + _HAND_PX[1]]
    below += scene.hand_alpha * (scene.hand - below)
    return view


def _background(scene: Scene, t_s: float, phase: int) -> Float32[np.ndarray, "480 640 3"]:
    """The table, turned and shifted as the camera swings; bilinear between pixels."""
    swing_px, width_px = SWING_PX[scene.camera], _BACKGROUND_PX[1]
    angle_rad = np.radians(swing_px / 12 * np.sin(0.7 * t_s + phase))
    y_px = np.arange(IMAGE_SHAPE[0])[:, None] - 240 - swing_px * np.cos(0.8 * t_s + phase)
    x_px = np.arange(IMAGE_SHAPE[1])[None] - 320 - swing_px * np.sin(1.1 * t_s)
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    y = (cos * y_px + sin * x_px + _BACKGROUND_PX[0] / 2).astype(np.float32)
    x = (cos * x_px - sin * y_px + width_px / 2).astype(np.float32)
    row, column = y.astype(np.intp), x.astype(np.intp)
    index = row * width_px + column
    below = (y - row.astype(np.float32))[..., None, None]
    right = (x - column.astype(np.float32))[..., None]
    pair = scene.pairs[index]
    pair += below * (scene.pairs[index + width_px] - pair)
    return (pair[:, :, 0] + right * (pair[:, :, 1] - pair[:, :, 0]))[..., :3]


def _texture(
    rng: np.random.Generator, height_px: int, width_px: int
) -> Float32[np.ndarray, "h w 3"]:
    """Colour noise whose amplitude falls with frequency, stretched to 0 … 255."""
    cycles = np.hypot(
        np.fft.fftfreq(height_px, d=1 / width_px)[:, None],
        np.fft.rfftfreq(width_px, d=1 / width_px)[None],
    )
    gain = np.maximum(cycles, 2.0) ** -_SLOPE * np.exp(-((cycles / _CUTOFF_CYCLES) ** 2))
    gain[0, 0] = 0.0
    noise = rng.standard_normal((3, height_px, width_px), dtype=np.float32)
    spectrum = np.fft.rfft2(noise) * gain.astype(np.float32)
    texture = np.fft.irfft2(spectrum, s=(height_px, width_px)).transpose(1, 2, 0)
    low, high = texture.min(), texture.max()
    return np.ascontiguousarray((texture - low) / (high - low) * 255.0, dtype=np.float32)


def _draw_box(picture: np.ndarray, rng: np.random.Generator) -> None:
    y, x = (int(v) for v in rng.integers(0, 1000, 2))
    height_px, width_px = int(rng.integers(8, 90)), int(rng.integers(10, 120))
    picture[y : y + height_px, x : x + width_px] = rng.integers(0, 255, 3)


def _draw_word(picture: np.ndarray, rng: np.random.Generator) -> None:
    """Draw ten glyphs of random strokes in one colour, with edges like those of print."""
    signs: Bool[np.ndarray, "10 7 6"] = np.zeros((10, 7, 6), dtype=bool)
    for row in (0, 3, 6):
        signs[:, row, :5] = rng.random((10, 1)) < 0.6
    for column in (0, 4):
        signs[:, :4, column] |= rng.random((10, 1)) < 0.6
        signs[:, 3:, column] |= rng.random((10, 1)) < 0.6
    letters = np.kron(np.concatenate(list(signs), axis=1), np.ones((3, 3), dtype=bool))
    y, x = int(rng.integers(40, 960)), int(rng.integers(0, 1100))
    below = picture[y : y + letters.shape[0], x : x + letters.shape[1]]
    below[letters] = rng.integers(0, 255, 3)


def _hand_alpha() -> Float32[np.ndarray, "200 260"]:
    """A palm with five fingers, 1 inside and 0 outside, with a soft edge."""
    y, x = np.mgrid[: _HAND_PX[0], : _HAND_PX[1]]
    inside = ((x - 130) / 60) ** 2 + ((y - 120) / 50) ** 2 <= 1
    for finger in range(5):
        start = np.array([90.0 + 20 * finger, 100.0])
        along = np.array([40.0 + 45 * finger, 15.0]) - start
        at = ((x - start[0]) * along[0] + (y - start[1]) * along[1]) / (along @ along)
        at = np.clip(at, 0.0, 1.0)
        inside |= np.hypot(x - start[0] - at * along[0], y - start[1] - at * along[1]) <= 9
    return gaussian_filter(inside.astype(np.float32), 1.5)


# Timestamps start slightly after zero, so that jitter never makes them negative.
FIRST_STAMP_NS = 10_000_000
JITTER_NS = 200_000
_SHAPES = {"keypoints": (25, 3), "wrist": (7,), "head": (7,), "action": (67,)}


def make_take(
    seconds: float, seed: int, *, on_camera: Callable[[str], None] = lambda _: None
) -> Workload:
    """Generate the streams of one take of whole images, deterministic by seed and length.

    `on_camera` is called with a camera's name before it is rendered, from its thread.
    """
    rng = np.random.default_rng(seed)
    camera_rngs = rng.spawn(len(CAMERAS))
    num_images = round(seconds * IMAGE_RATE_HZ)

    def one_camera(index: int) -> np.ndarray:
        camera_rng = camera_rngs[index]
        on_camera(CAMERAS[index])
        return render(make_scene(CAMERAS[index], camera_rng), num_images, camera_rng)

    with ThreadPoolExecutor(len(CAMERAS)) as threads:
        pictures = list(threads.map(one_camera, range(len(CAMERAS))))
    return Workload(
        seconds,
        {
            camera: TimedStream(images, _stamps(num_images, IMAGE_RATE_HZ, rng), IMAGE_RATE_HZ)
            for camera, images in zip(CAMERAS, pictures, strict=True)
        },
        {
            name: TimedStream(
                _numbers(name, round(seconds * rate_hz), rng),
                _stamps(round(seconds * rate_hz), rate_hz, rng),
                rate_hz,
            )
            for name, rate_hz in NUMERIC_RATES_HZ.items()
        },
    )


def _stamps(count: int, rate_hz: int, rng: np.random.Generator) -> np.ndarray:
    steady = np.arange(count, dtype=np.int64) * 1_000_000_000 // rate_hz
    return FIRST_STAMP_NS + steady + rng.normal(0, JITTER_NS, count).astype(np.int64)


def _numbers(name: str, count: int, rng: np.random.Generator) -> np.ndarray:
    kind = name.removesuffix("_left").removesuffix("_right")
    if kind == "tactile":
        return _tactile(count, phase=float(name.endswith("right")), rng=rng)
    # Slow motion with the noise of a tracker.
    shape = (count, *_SHAPES[kind])
    motion = np.cumsum(rng.normal(0, 1e-3, shape), axis=0)
    return np.asarray(motion + rng.normal(0, 1e-4, shape), dtype=np.float32)


def _tactile(count: int, *, phase: float, rng: np.random.Generator) -> UInt16[np.ndarray, "n 360"]:
    """Counts of a glove: five spots that are pressed and released, plus noise of every cell."""
    t_s = np.arange(count)[:, None] / NUMERIC_RATES_HZ["tactile_left"]
    cell = np.arange(360)[None]
    pressed = np.zeros((count, 360))
    for place in (20, 90, 170, 250, 320):
        strength = np.clip(np.sin(0.8 * t_s + place + phase), 0.0, 1.0)
        pressed += np.exp(-(((cell - place) / 9.0) ** 2)) * strength
    counts = 40 + 3000 * pressed + rng.normal(0, 3, (count, 360))
    return np.clip(counts, 0, 4095).astype(np.uint16)
