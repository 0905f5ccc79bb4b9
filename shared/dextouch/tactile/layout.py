"""Taxels of a glove: their layout on the hand, contact, forces of pads, and heat maps.

Anatomical order of the 320 taxels, the same for both hands: thumb, index, middle, ring and little
fingertip, 4×4 each, then the palm, 15×16. Inside every pad axis 0 runs from distal to proximal and
axis 1 from radial (thumb side) to ulnar, so that a left and a right hand doing the same thing give
the same numbers.
"""

from functools import cache
from typing import Final, Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from dextouch.errors import NonFiniteError, ShapeError, UnknownNameError

Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")
FINGERS = ("thumb", "index", "middle", "ring", "little")
NUM_RAW_TAXELS = 360
NUM_FINGERTIPS = 5
TIP_SHAPE = (4, 4)
PALM_SHAPE = (15, 16)
NUM_TIP_TAXELS = NUM_FINGERTIPS * TIP_SHAPE[0] * TIP_SHAPE[1]
NUM_TAXELS = NUM_TIP_TAXELS + PALM_SHAPE[0] * PALM_SHAPE[1]
TIP_PITCH_M = 0.004
PALM_PITCH_M = (0.006, 0.005)
TIP_TAXEL_AREA_M2 = TIP_PITCH_M**2
PALM_TAXEL_AREA_M2 = PALM_PITCH_M[0] * PALM_PITCH_M[1]
_SCAN_SHAPE = (18, 20)
CONTACT_THRESHOLD_KPA = 2.0
PADS: Final = (*FINGERS, "palm")
_PASCAL_PER_KPA: Final = 1000.0
# Top-left cell of each pad for a right hand seen from its palm: fingers up, thumb to the right.
_CANVAS_SHAPE = (28, 26)
_PALM_ORIGIN = (13, 0)
_TIP_ORIGINS = ((8, 21), (3, 13), (0, 9), (2, 5), (5, 0))
# Colour map: dark blue, violet, orange, pale yellow.
_RAMP = np.array([(13, 17, 40), (92, 32, 110), (226, 92, 44), (255, 240, 170)], dtype=np.float64)
_EMPTY = np.array((247, 247, 245), dtype=np.uint8)


def taxel_areas_m2() -> np.ndarray:
    """Sensing area of each of the 320 taxels in m² (force = pressure × area)."""
    areas = np.full(NUM_TAXELS, PALM_TAXEL_AREA_M2)
    areas[:NUM_TIP_TAXELS] = TIP_TAXEL_AREA_M2
    return areas


@cache
def raw_indices(*, side: Side, glove_model: str = "dextouch_v1") -> Int64[np.ndarray, "320"]:
    """Raw cell of each taxel; read-only.

    `dextouch_v1` scans 18 rows × 20 columns. Rows 0–3 hold the five fingertips side by side,
    rows 4–15 the palm row by row, rows 16–17 are unused (40 cells). The left glove is wired as
    the mirror image: its columns run the other way.
    """
    if glove_model != "dextouch_v1":
        raise UnknownNameError("glove model", glove_model, ["dextouch_v1"])
    if side not in SIDES:
        raise UnknownNameError("side", side, list(SIDES))
    cells = np.arange(NUM_RAW_TAXELS).reshape(_SCAN_SHAPE)
    if side == "left":
        cells = cells[:, ::-1]
    tips = cells[:4].reshape(4, NUM_FINGERTIPS, 4).transpose(1, 0, 2).ravel()
    palm = cells[4:16].ravel()
    indices = np.concatenate([tips, palm]).astype(np.int64)
    indices.flags.writeable = False
    return indices


def select_taxels(raw: np.ndarray, *, side: Side, glove_model: str = "dextouch_v1") -> np.ndarray:
    """The 320 taxels, in anatomical order, of raw readings [..., 360]; dtype is kept.

    Raises:
        ShapeError: the last axis is not 360.
        UnknownNameError: unknown side or glove model.
    """
    raw = np.asarray(raw)
    if raw.shape[-1:] != (NUM_RAW_TAXELS,):
        raise ShapeError(f"raw taxels: got shape {raw.shape}, expected [..., {NUM_RAW_TAXELS}]")
    return raw[..., raw_indices(side=side, glove_model=glove_model)]


def expand_taxels(
    taxels: np.ndarray, *, side: Side, glove_model: str = "dextouch_v1"
) -> np.ndarray:
    """Raw readings [..., 360] from taxels [..., 320]; cells without a taxel are zero.

    Raises:
        ShapeError: the last axis is not 320.
        UnknownNameError: unknown side or glove model.
    """
    taxels = np.asarray(taxels)
    if taxels.shape[-1:] != (NUM_TAXELS,):
        raise ShapeError(f"taxels: got shape {taxels.shape}, expected [..., {NUM_TAXELS}]")
    raw = np.zeros((*taxels.shape[:-1], NUM_RAW_TAXELS), dtype=taxels.dtype)
    raw[..., raw_indices(side=side, glove_model=glove_model)] = taxels
    return raw


def split_pads(taxels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fingertips [..., 5, 4, 4] and palm [..., 15, 16] of taxels [..., 320] (views)."""
    taxels = np.asarray(taxels)
    if taxels.shape[-1:] != (NUM_TAXELS,):
        raise ShapeError(f"taxels: got shape {taxels.shape}, expected [..., {NUM_TAXELS}]")
    tips = taxels[..., :NUM_TIP_TAXELS].reshape(*taxels.shape[:-1], NUM_FINGERTIPS, *TIP_SHAPE)
    return tips, taxels[..., NUM_TIP_TAXELS:].reshape(*taxels.shape[:-1], *PALM_SHAPE)


def join_pads(fingertips: np.ndarray, palm: np.ndarray) -> np.ndarray:
    """Taxels [..., 320] from fingertips [..., 5, 4, 4] and palm [..., 15, 16]."""
    fingertips, palm = np.asarray(fingertips), np.asarray(palm)
    if fingertips.shape[-3:] != (NUM_FINGERTIPS, *TIP_SHAPE) or palm.shape[-2:] != PALM_SHAPE:
        raise ShapeError(
            f"pads: got {fingertips.shape} and {palm.shape}, expected [..., 5, 4, 4] and "
            "[..., 15, 16]"
        )
    return np.concatenate(
        [
            fingertips.reshape(*fingertips.shape[:-3], NUM_TIP_TAXELS),
            palm.reshape(*palm.shape[:-2], NUM_TAXELS - NUM_TIP_TAXELS),
        ],
        axis=-1,
    )


def in_contact(tactile_kpa: np.ndarray) -> Bool[np.ndarray, "..."]:
    """Mask of taxels in contact: pressure of at least 2 kPa. NaN is not contact."""
    return np.asarray(tactile_kpa) >= CONTACT_THRESHOLD_KPA


def pad_forces_n(tactile_kpa: np.ndarray) -> Float64[np.ndarray, "time 6"]:
    """Normal force (N) on thumb … little fingertip and palm: pressure times area.

    Only taxels in contact count (`in_contact`), so that noise of the others does not add up.

    Args:
        tactile_kpa: [T, 320], anatomical order.

    Raises:
        ShapeError: not [T, 320].
        NonFiniteError: NaN or infinity; a taxel that was not measured is zero.
    """
    kpa = np.asarray(tactile_kpa, dtype=np.float64)
    if kpa.ndim != 2 or kpa.shape[1] != NUM_TAXELS:
        raise ShapeError(f"pad forces: got shape {kpa.shape}, expected [T, {NUM_TAXELS}]")
    if not np.isfinite(kpa).all():
        raise NonFiniteError("pad forces: taxels hold NaN or infinity; set unmeasured ones to zero")
    forces = np.where(in_contact(kpa), kpa, 0.0) * taxel_areas_m2() * _PASCAL_PER_KPA
    tips, palm = split_pads(forces)
    return np.concatenate([tips.sum(axis=(2, 3)), palm.sum(axis=(1, 2))[:, None]], axis=1)


def hand_canvas(taxels: np.ndarray, *, side: Side) -> Float32[np.ndarray, "28 26"]:
    """Taxels [320] laid out as a hand on a 28×26 grid; cells without a taxel are NaN."""
    tips, palm = split_pads(np.asarray(taxels, dtype=np.float32))
    canvas = np.full(_CANVAS_SHAPE, np.nan, dtype=np.float32)
    # Radial is on the right of a right palm, while arrays run from radial to ulnar.
    row, column = _PALM_ORIGIN
    canvas[row : row + PALM_SHAPE[0], column : column + PALM_SHAPE[1]] = palm[:, ::-1]
    for tip, (row, column) in zip(tips, _TIP_ORIGINS, strict=True):
        canvas[row : row + 4, column : column + 4] = tip[:, ::-1]
    return canvas if side == "right" else canvas[:, ::-1]


def colour(values_kpa: np.ndarray, *, full_scale_kpa: float = 40.0) -> UInt8[np.ndarray, "*s 3"]:
    """Map pressures to RGB on a square-root scale, which shows light touch; NaN is background."""
    values = np.asarray(values_kpa, dtype=np.float64)
    level = np.sqrt(np.clip(np.nan_to_num(values) / full_scale_kpa, 0.0, 1.0)) * (len(_RAMP) - 1)
    left = np.minimum(level.astype(int), len(_RAMP) - 2)
    weight = (level - left)[..., None]
    rgb = ((1 - weight) * _RAMP[left] + weight * _RAMP[left + 1]).astype(np.uint8)
    rgb[np.isnan(values)] = _EMPTY
    return rgb
