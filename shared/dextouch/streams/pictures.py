"""Finds images that no working camera takes though their bytes are valid, by small copies of them.

Stations apply it to the last seconds, alignment to recordings. Noise of sensors and encoders
averages out over a block of a copy, so that equal contents look equal.
"""

from itertools import pairwise
from typing import Final

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from dextouch.streams.repeats import ImageFault, spread

IMAGE_FAULTS: Final[dict[ImageFault, str]] = {
    "black": "black images between others",
    "torn": "images with rows of another, or without content",
    "pumping": "images whose light pumps",
}
PICTURE_SHAPE = ROWS, COLUMNS = 24, 32
# Pixels in a block along each axis of those that are averaged: 64 of 400 of a VGA image.
_SAMPLES: Final = 8
_LEAST_IMAGES: Final = 6
# Blocks of quiet sensors and encoders scatter by so many levels, and what moves by times as much.
NOISE_LEVELS, MOVES = 0.25, 5.0
# Sensors have a pedestal of some levels at most; rooms are brighter than the second.
DARK_LEVEL, LIT_LEVEL = 8.0, 30.0
# What decoders write where data ends: grey, nothing, or the green of zeros in YUV. It is more even
# than rows of sensors, and both sides of a line have rows enough to be no hand that comes and goes.
FILLS: Final = (128.0, 0.0, 135.0)
EVEN_LEVELS: Final = 1.0
MIN_ROWS: Final = 3
# Rows of another image are off both neighbours by times what these are off each other, and more:
# in a motion that goes on they are off by half of it.
ALIEN, ALIEN_LEVELS = 1.6, 6.0
# Light that is switched off stays off for longer: a second at 30 Hz.
MAX_BLACK: Final = 30
# Light of all blocks alike changes by so much in one image, both ways, in a second of pumping.
PUMPED: Final = 0.04
MIN_PUMPED: Final = 2


def thumbnail(image: UInt8[np.ndarray, "h w *c"]) -> Float32[np.ndarray, "24 32"]:
    """Mean levels of blocks of an image: of its green, or of its only channel."""
    image = image.reshape(*image.shape[:2], -1)
    rows, columns = (
        (2 * np.arange(count * _SAMPLES) + 1) * size // (2 * count * _SAMPLES)
        for count, size in zip(PICTURE_SHAPE, image.shape, strict=False)
    )
    chosen = image[rows[:, None], columns, image.shape[2] // 2]
    blocks = chosen.reshape(ROWS, _SAMPLES, COLUMNS, _SAMPLES).sum(axis=1, dtype=np.uint16)
    return blocks.sum(axis=-1, dtype=np.uint16) / np.float32(_SAMPLES * _SAMPLES)


def apart(some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Mean levels by which pictures [n, 24, 32] differ, but for the light of a whole image."""
    difference = some - others
    difference -= difference.mean(axis=(-2, -1), keepdims=True)
    return np.asarray(np.abs(difference).mean(axis=(-2, -1)))


def image_faults(
    pictures: Float32[np.ndarray, "n 24 32"],
) -> dict[ImageFault, Bool[np.ndarray, " n"]]:
    """Which of consecutive pictures, by `thumbnail`, have a fault of `IMAGE_FAULTS`; one at most.

    Rows that stay those of the image before are no fault: they may show what stands still. Nor is a
    picture that came before, or out of order: a finger that taps or a wheel shows the same.
    """
    count, found = len(pictures), dict[ImageFault, np.ndarray]()
    if count < _LEAST_IMAGES:
        return found
    means = pictures.mean(axis=(1, 2))
    dark, found["black"] = means < DARK_LEVEL, np.zeros(count, dtype=bool)
    turns = np.flatnonzero(np.diff(dark)) + 1
    for first, stop in pairwise(turns.tolist()):
        found["black"][first:stop] = dark[first] and stop - first <= MAX_BLACK
    found["black"] &= np.median(means) > LIT_LEVEL
    found["torn"] = _filled(pictures[:, -MIN_ROWS:].reshape(count, -1)) & ~found["black"]
    ordinary = np.flatnonzero(~dark & ~found["torn"])
    pictures = pictures[ordinary]
    if len(pictures) >= _LEAST_IMAGES:
        pumping = _pumping(pictures)
        # Light that pumps makes rows unlike others, too.
        found["torn"] |= spread(_alien(pictures) & ~pumping.any(), ordinary, count)
        found["pumping"] = spread(pumping, ordinary, count)
    return {name: marked for name, marked in found.items() if marked.any()}


def _filled(last: np.ndarray) -> Bool[np.ndarray, " n"]:
    """Pictures whose `last` rows are what decoders fill in, unlike those of both neighbours."""
    near_fill = (np.abs(last.mean(axis=1)[:, None] - FILLS) < 3 * EVEN_LEVELS).any(axis=1)
    unlike = np.zeros(len(last), dtype=bool)
    # A scene that looks so, such as a plain wall, stays for more than an image or two.
    for by in (1, 2):
        differs = np.abs(last[by:] - last[:-by]).mean(axis=1) > ALIEN_LEVELS
        unlike[by:-by] |= differs[:-by] & differs[by:]
    return near_fill & unlike & (np.ptp(last, axis=1) < EVEN_LEVELS)


def noise_levels(pictures: Float32[np.ndarray, "n 24 32"]) -> float:
    """Mean difference of two pictures of the same: what the quietest blocks turn back and forth."""
    turns = np.abs(pictures[2:] - 2 * pictures[1:-1] + pictures[:-2])
    # Second differences of noise are √3 times first ones, whose mean is 1.18 times their median.
    turn = float(np.percentile(np.median(turns, axis=0), 5))
    return max(NOISE_LEVELS, 1.18 * turn / 3**0.5)


def is_same_picture(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two pictures show the same but for the noise of a dark room, of some 1 level."""
    return float(apart(one, other)) < MOVES * NOISE_LEVELS


def _alien(pictures: np.ndarray) -> Bool[np.ndarray, " n"]:
    """Pictures whose upper or lower rows are unlike those of the images beside, which are alike."""
    # Half of a row: no hand that shows for an image.
    step = np.median(np.abs(np.diff(pictures, axis=0)), axis=2)
    two = np.median(np.abs(pictures[2:] - pictures[:-2]), axis=2)
    alien = np.minimum(step[:-1], step[1:]) > ALIEN * two + ALIEN_LEVELS
    count = alien.sum(axis=1)
    # From the first such row down, or from the last one up; some may look alike.
    heights = [ROWS - rows.argmax(axis=1) for rows in (alien, alien[:, ::-1])]
    torn = count >= 0.75 * np.minimum(*heights)
    # Rolling shutters in light that flickers show bands in image after image.
    alone = np.convolve(count >= MIN_ROWS, np.ones(min(9, len(count))), mode="same") < 2
    return np.pad(torn & alone & (count >= MIN_ROWS) & (count <= ROWS - MIN_ROWS), 1)


def _pumping(pictures: np.ndarray) -> Bool[np.ndarray, " n"]:
    ratios = np.diff(np.log(np.maximum(pictures, 2.0)), axis=0)
    low, middle, high = np.percentile(ratios, (25, 50, 75), axis=(1, 2))
    pumped = (np.abs(middle) > PUMPED) & (high - low < 0.5 * np.abs(middle))
    near = np.ones(min(31, len(pumped)))
    for way in (middle > 0, middle < 0):
        pumped &= np.convolve(pumped & way, near, mode="same") >= MIN_PUMPED
    return np.append(False, pumped)
