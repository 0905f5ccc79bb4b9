"""Layouts of tactile gloves, with contact, forces of pads and heat maps of their taxels.

Anatomical order of the taxels, the same for both hands: pad by pad, the fingers from the thumb to
the little one, then the palm. Inside every pad axis 0 runs from distal to proximal and axis 1 from
radial (thumb side) to ulnar. `DEXTOUCH_V1` is that of streams and episodes that name no other.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Final, Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from pydantic import ValidationError

from dextouch.data_folder import read_bounded
from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError, UnknownNameError
from dextouch.frozen_model import first_problem
from dextouch.tactile.description import (
    KPA_PER_UNIT,
    NEWTON,
    PADS,
    LayoutDescription,
    RawCells,
    TactilePad,
)

Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")
FINGERS = ("thumb", "index", "middle", "ring", "little")
CONTACT_THRESHOLD_KPA = 2.0
_PASCAL_PER_KPA: Final = 1000.0
MAX_LAYOUT_BYTES: Final = 256 * 2**10

# Facts of `dextouch_v1`.
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
_V1_NAME: Final = "dextouch_v1"
# Colour map: dark blue, violet, orange, pale yellow.
_RAMP = np.array([(13, 17, 40), (92, 32, 110), (226, 92, 44), (255, 240, 170)], dtype=np.float64)
_EMPTY = np.array((247, 247, 245), dtype=np.uint8)


class TactileLayout(LayoutDescription):
    """Layout of a tactile glove for arrays whose last axis are taxels in anatomical order."""

    @classmethod
    def of(cls, description: LayoutDescription | None) -> "TactileLayout | None":
        """The layout that a description, such as that of a world, is of; None of none."""
        return None if description is None else cls.model_validate(description.model_dump())

    @cached_property
    def areas_m2(self) -> Float64[np.ndarray, " taxels"]:
        """Sensing area of each taxel in m² (force = pressure × area); read-only."""
        areas = [np.full(pad.num_taxels, pad.taxel_area_m2) for pad in self.pads]
        return _read_only(np.concatenate(areas))

    @cached_property
    def nominal_kpa_per_unit(self) -> Float64[np.ndarray, " taxels"] | None:
        """Pressure of a unit of each taxel, None if only calibration knows it; read-only."""
        if self.unit == NEWTON:
            return _read_only(1.0 / (_PASCAL_PER_KPA * self.areas_m2))
        scale = KPA_PER_UNIT.get(self.unit, self.kpa_per_unit)
        return None if scale is None else _read_only(np.full(self.num_taxels, scale))

    @cached_property
    def _indices(self) -> dict[Side, Int64[np.ndarray, " taxels"]]:
        return {
            side: _read_only(np.array(getattr(self.raw_cells, side), dtype=np.int64))
            for side in SIDES
        }

    def raw_indices(self, side: Side) -> Int64[np.ndarray, " taxels"]:
        """Raw cell of each taxel; read-only.

        Raises:
            UnknownNameError: unknown side.
        """
        if side not in SIDES:
            raise UnknownNameError("side", side, list(SIDES))
        return self._indices[side]

    def check(self, taxels: np.ndarray, *, what: str = "taxels") -> np.ndarray:
        """The array, whose last axis must be the taxels of one hand.

        Raises:
            ShapeError: it is not.
        """
        taxels = np.asarray(taxels)
        if taxels.shape[-1:] != (self.num_taxels,):
            raise ShapeError(
                f"{what}: got shape {taxels.shape}, expected [..., {self.num_taxels}] of layout "
                f"{self.name!r}"
            )
        return taxels

    def select(self, raw: np.ndarray, *, side: Side) -> np.ndarray:
        """Taxels in anatomical order of raw readings [..., cells]; dtype is kept.

        Raises:
            ShapeError: another number of cells.
            UnknownNameError: unknown side.
        """
        raw = np.asarray(raw)
        if raw.shape[-1:] != (self.num_raw_cells,):
            raise ShapeError(
                f"raw taxels: got shape {raw.shape}, expected [..., {self.num_raw_cells}]"
            )
        return raw[..., self.raw_indices(side)]

    def expand(self, taxels: np.ndarray, *, side: Side) -> np.ndarray:
        """Raw readings [..., cells] from taxels; cells without a taxel are zero.

        Raises:
            ShapeError: another number of taxels.
            UnknownNameError: unknown side.
        """
        taxels = self.check(taxels)
        raw = np.zeros((*taxels.shape[:-1], self.num_raw_cells), dtype=taxels.dtype)
        raw[..., self.raw_indices(side)] = taxels
        return raw

    def split(self, taxels: np.ndarray) -> list[np.ndarray]:
        """Stacks [..., pads, rows, columns] of pads of one shape that follow each other (views).

        Of `dextouch_v1` these are the five fingertips, then the palm.
        """
        taxels = self.check(taxels)
        stacks, first = [], 0
        for count, shape in self._stacks:
            stop = first + count * shape[0] * shape[1]
            stacks.append(taxels[..., first:stop].reshape(*taxels.shape[:-1], count, *shape))
            first = stop
        return stacks

    def join(self, stacks: Sequence[np.ndarray]) -> np.ndarray:
        """Taxels from stacks as of `split`.

        Raises:
            ShapeError: stacks of other pads.
        """
        expected = [(count, *shape) for count, shape in self._stacks]
        if [stack.shape[-3:] for stack in stacks] != expected:
            raise ShapeError(
                f"pads: got {[stack.shape for stack in stacks]}, expected stacks that end in "
                f"{expected} of layout {self.name!r}"
            )
        flat = [stack.reshape(*stack.shape[:-3], -1) for stack in stacks]
        return np.concatenate(flat, axis=-1)

    def by_part(self, taxels: np.ndarray, reduce: Callable[..., np.ndarray]) -> np.ndarray:
        """One value for each of `PADS` [..., 6]; 0 of a part without taxels.

        Args:
            taxels: [..., taxels].
            reduce: takes pads [..., rows, columns] and the axes to reduce, such as `np.mean`.
        """
        stacks = self.split(taxels)
        pads = np.concatenate([reduce(stack, axis=(-2, -1)) for stack in stacks], axis=-1)
        if len(self.pads) == len(PADS):
            return pads
        parts = np.zeros((*pads.shape[:-1], len(PADS)), dtype=pads.dtype)
        parts[..., [PADS.index(pad.part) for pad in self.pads]] = pads
        return parts

    @cached_property
    def _stacks(self) -> list[tuple[int, tuple[int, int]]]:
        """Numbers and shapes of the pads of `split`; the palm has a stack of its own."""
        stacks: list[tuple[int, tuple[int, int]]] = []
        for pad in self.pads:
            if stacks and stacks[-1][1] == pad.shape and pad.part != "palm":
                stacks[-1] = (stacks[-1][0] + 1, pad.shape)
            else:
                stacks.append((1, pad.shape))
        return stacks

    def pad_forces_n(self, tactile_kpa: np.ndarray) -> Float64[np.ndarray, "time 6"]:
        """Normal force (N) on thumb … little finger and palm: pressure times area.

        Only taxels in contact count (`in_contact`), so that noise of the others does not add up.
        The force of a part without taxels is 0.

        Args:
            tactile_kpa: [T, taxels], anatomical order.

        Raises:
            ShapeError: not [T, taxels].
            NonFiniteError: NaN or infinity; a taxel that was not measured is zero.
        """
        kpa = np.asarray(tactile_kpa, dtype=np.float64)
        if kpa.ndim != 2 or kpa.shape[1] != self.num_taxels:
            raise ShapeError(f"pad forces: got shape {kpa.shape}, expected [T, {self.num_taxels}]")
        if not np.isfinite(kpa).all():
            raise NonFiniteError(
                "pad forces: taxels hold NaN or infinity; set unmeasured ones to zero"
            )
        forces = np.where(in_contact(kpa), kpa, 0.0) * self.areas_m2 * _PASCAL_PER_KPA
        return self.by_part(forces, np.sum)

    def hand_canvas(self, taxels: np.ndarray, *, side: Side) -> Float32[np.ndarray, "rows columns"]:
        """Taxels of one hand laid out on the canvas; cells without a taxel are NaN."""
        values = self.check(np.asarray(taxels, dtype=np.float32))
        canvas = np.full(self.canvas, np.nan, dtype=np.float32)
        for pad, start in zip(self.pads, self.starts, strict=True):
            (row, column), (rows, columns) = pad.origin, pad.shape
            # Radial is on the right of a right hand, while arrays run from radial to ulnar.
            cells = values[start : start + pad.num_taxels].reshape(pad.shape)[:, ::-1]
            canvas[row : row + rows, column : column + columns] = cells
        return canvas if side == "right" else canvas[:, ::-1]


def _read_only(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array


def _dextouch_v1() -> TactileLayout:
    """Layout of our own glove, which scans 18 rows × 20 columns.

    Rows 0–3 hold the five fingertips side by side, rows 4–15 the palm, rows 16–17 are unused. The
    left glove is wired as the mirror image: its columns run the other way.
    """
    scan = np.arange(NUM_RAW_TAXELS).reshape(_SCAN_SHAPE)

    def order(cells: np.ndarray) -> tuple[int, ...]:
        tips = cells[:4].reshape(4, NUM_FINGERTIPS, 4).transpose(1, 0, 2).ravel()
        return tuple(np.concatenate([tips, cells[4:16].ravel()]).tolist())

    tip_origins = ((8, 21), (3, 13), (0, 9), (2, 5), (5, 0))
    tips = [
        TactilePad(
            part=part,
            rows=TIP_SHAPE[0],
            columns=TIP_SHAPE[1],
            pitch_m=(TIP_PITCH_M, TIP_PITCH_M),
            taxel_area_m2=TIP_TAXEL_AREA_M2,
            origin=origin,
        )
        for part, origin in zip(PADS, tip_origins, strict=False)
    ]
    palm = TactilePad(
        part="palm",
        rows=PALM_SHAPE[0],
        columns=PALM_SHAPE[1],
        pitch_m=PALM_PITCH_M,
        taxel_area_m2=PALM_TAXEL_AREA_M2,
        origin=(13, 0),
    )
    return TactileLayout(
        name=_V1_NAME,
        pads=(*tips, palm),
        num_raw_cells=NUM_RAW_TAXELS,
        raw_cells=RawCells(left=order(scan[:, ::-1]), right=order(scan)),
        canvas=(28, 26),
        unit="counts",
        # 16 bits a cell, and some 40 counts per kPa (docs/device_packets.md).
        full_scale=65_535.0,
        range_kpa=1600.0,
        nominal_rate_hz=60.0,
    )


DEXTOUCH_V1: Final = _dextouch_v1()


def read_layout(path: Path | str) -> TactileLayout:
    """The layout of a glove from a JSON file (docs/stations.md#layout-of-a-glove).

    Raises:
        NotFoundError, StorageError: a missing or unreadable file.
        LimitExceededError: more than 256 KiB.
        InvalidInputError: no JSON, or no valid layout; the message names file, field, what it
            holds and what was expected.
    """
    path = Path(path)
    data = read_bounded(path, MAX_LAYOUT_BYTES)
    try:
        return TactileLayout.model_validate_json(data.removeprefix(b"\xef\xbb\xbf"))
    except ValidationError as error:
        raise InvalidInputError(f"layout {path}: {first_problem(error)}") from error


def common_layout(layouts: Sequence[TactileLayout], *, what: str) -> TactileLayout:
    """The one layout of several streams; `DEXTOUCH_V1` of none.

    Args:
        layouts: of gloves, streams or episodes.
        what: they belong to, for the message.

    Raises:
        InvalidInputError: they are not all the same.
    """
    kinds = {layout.fingerprint: layout for layout in layouts}
    if len(kinds) > 1:
        raise InvalidInputError(
            f"{what}: got tactile layouts {described(list(kinds.values()))}, expected one layout "
            "throughout; use gloves of one kind, and keep others in a store of their own"
        )
    return next(iter(kinds.values()), DEXTOUCH_V1)


def described(layouts: Sequence[TactileLayout]) -> str:
    """Names of layouts with their number of taxels and fingerprint, for messages."""
    return ", ".join(
        f"{one.name!r} ({one.num_taxels} taxels, {one.fingerprint[:8]})" for one in layouts
    )


# The promised functions of `dextouch_v1`.


def select_taxels(raw: np.ndarray, *, side: Side, glove_model: str = _V1_NAME) -> np.ndarray:
    """The 320 taxels, in anatomical order, of raw readings [..., 360]; dtype is kept.

    Raises:
        ShapeError: the last axis is not 360.
        UnknownNameError: unknown side or glove model.
    """
    return _layout_named(glove_model).select(raw, side=side)


def expand_taxels(taxels: np.ndarray, *, side: Side, glove_model: str = _V1_NAME) -> np.ndarray:
    """Raw readings [..., 360] from taxels [..., 320]; cells without a taxel are zero.

    Raises:
        ShapeError: the last axis is not 320.
        UnknownNameError: unknown side or glove model.
    """
    return _layout_named(glove_model).expand(taxels, side=side)


def split_pads(taxels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fingertips [..., 5, 4, 4] and palm [..., 15, 16] of taxels [..., 320] (views)."""
    tips, palm = DEXTOUCH_V1.split(taxels)
    return tips, palm[..., 0, :, :]


def join_pads(fingertips: np.ndarray, palm: np.ndarray) -> np.ndarray:
    """Taxels [..., 320] from fingertips [..., 5, 4, 4] and palm [..., 15, 16].

    Raises:
        ShapeError: other shapes.
    """
    palm = np.asarray(palm)
    if palm.shape[-2:] != PALM_SHAPE:
        raise ShapeError(f"palm: got shape {palm.shape}, expected [..., 15, 16]")
    return DEXTOUCH_V1.join([np.asarray(fingertips), palm[..., None, :, :]])


def _layout_named(glove_model: str) -> TactileLayout:
    if glove_model != _V1_NAME:
        raise UnknownNameError("glove model", glove_model, [_V1_NAME])
    return DEXTOUCH_V1


# Contact and colours.


def in_contact(tactile_kpa: np.ndarray) -> Bool[np.ndarray, "..."]:
    """Mask of taxels in contact: pressure of at least 2 kPa. NaN is not contact."""
    return np.asarray(tactile_kpa) >= CONTACT_THRESHOLD_KPA


def colour(values_kpa: np.ndarray, *, full_scale_kpa: float = 40.0) -> UInt8[np.ndarray, "*s 3"]:
    """Map pressures to RGB on a square-root scale, which shows light touch; NaN is background."""
    values = np.asarray(values_kpa, dtype=np.float64)
    level = np.sqrt(np.clip(np.nan_to_num(values) / full_scale_kpa, 0.0, 1.0)) * (len(_RAMP) - 1)
    left = np.minimum(level.astype(int), len(_RAMP) - 2)
    weight = (level - left)[..., None]
    rgb = ((1 - weight) * _RAMP[left] + weight * _RAMP[left + 1]).astype(np.uint8)
    rgb[np.isnan(values)] = _EMPTY
    return rgb
