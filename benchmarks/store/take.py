"""Synthetic take of a whole station for the store benchmark."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import UInt16

from benchmarks.store.scene import make_scene, render
from benchmarks.store.workload import (
    CAMERAS,
    IMAGE_RATE_HZ,
    NUMERIC_RATES_HZ,
    TimedStream,
    Workload,
)

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
