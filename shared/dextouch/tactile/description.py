"""Description of a tactile glove, without arrays: its pads, its wiring, what its readings mean."""

import hashlib
import itertools
import json
from collections import Counter
from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any, Final, Literal, TypeVar

from pydantic import BeforeValidator, Field, FiniteFloat, PlainSerializer, model_validator
from pydantic_core import from_json

from dextouch.frozen_model import FrozenModel

Part = Literal["thumb", "index", "middle", "ring", "little", "palm"]
PADS: Final[tuple[Part, ...]] = ("thumb", "index", "middle", "ring", "little", "palm")
# Pressure in kPa of one unit of a reading, of units that need no calibration of their scale. Of
# newtons it follows from the area of each taxel.
KPA_PER_UNIT: Final = {"Pa": 1e-3, "mbar": 0.1, "kPa": 1.0, "psi": 6.894757}
NEWTON: Final = "N"
# Numbers of a sample: chosen, several times those of any glove on the market (548 in STAG, 768 in
# the Wuji glove), and little enough for a sample of float32 numbers in one packet of 16 KiB.
MAX_CELLS: Final = 4096
MAX_PAD_CELLS: Final = 64
# Longest distance between two taxels: chosen, the width of a hand.
MAX_PITCH_M: Final = 0.1
# Of a layout as one JSON text: of 4096 taxels it takes some 43 kB, most of it the cells.
MAX_LAYOUT_TEXT: Final = 64 * 2**10

DescriptionT = TypeVar("DescriptionT", bound="LayoutDescription")
Positive = Annotated[FiniteFloat, Field(gt=0)]
Cell = Annotated[int, Field(ge=0, lt=MAX_CELLS)]
Cells = Annotated[tuple[Cell, ...], Field(min_length=1, max_length=MAX_CELLS)]


class TactilePad(FrozenModel):
    """The taxels of one finger or of the palm: a grid of `rows` by `columns`.

    `pitch_m` is the distance between rows and between columns, `taxel_area_m2` the sensing area of
    one taxel (force = pressure × area). `origin` is the row and column of the pad's top-left taxel
    on the canvas of its layout.
    """

    part: Part
    rows: int = Field(ge=1, le=MAX_PAD_CELLS)
    columns: int = Field(ge=1, le=MAX_PAD_CELLS)
    pitch_m: tuple[
        Annotated[Positive, Field(le=MAX_PITCH_M)], Annotated[Positive, Field(le=MAX_PITCH_M)]
    ]
    taxel_area_m2: Annotated[Positive, Field(le=MAX_PITCH_M**2)]
    origin: tuple[Cell, Cell]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows, self.columns

    @property
    def num_taxels(self) -> int:
        """Taxels of the pad."""
        return self.rows * self.columns


class RawCells(FrozenModel):
    """Wiring of the two gloves: for each taxel in anatomical order its place in a raw sample."""

    left: Cells
    right: Cells


class LayoutDescription(FrozenModel):
    """Layout of a tactile glove: its pads, its wiring, and what its readings mean.

    Attributes:
        name: of the kind of glove.
        pads: at most one for each finger and the palm, in the order of `PADS`.
        num_raw_cells: numbers of a raw sample; those without a taxel are not used.
        raw_cells: place of each taxel in the raw samples of either glove.
        canvas: rows and columns of the grid on which the right hand is drawn, seen from its palm:
            fingers up, thumb to the right. The left hand is its mirror image.
        unit: of the raw readings, such as `counts` or `N`.
        kpa_per_unit: pressure of one unit. None where the unit says it (`KPA_PER_UNIT`, `N`), or
            where every cell has a gain of its own, which only calibration knows.
        full_scale: the largest raw reading.
        range_kpa: the largest pressure that the glove is made for.
        nominal_rate_hz: samples a second.
    """

    name: str = Field(pattern=r"^[a-z][a-z0-9_]{0,63}$")
    pads: tuple[TactilePad, ...] = Field(min_length=1, max_length=len(PADS))
    num_raw_cells: int = Field(ge=1, le=MAX_CELLS)
    raw_cells: RawCells
    canvas: tuple[
        Annotated[int, Field(ge=1, le=MAX_CELLS)], Annotated[int, Field(ge=1, le=MAX_CELLS)]
    ]
    unit: str = Field(min_length=1, max_length=32)
    kpa_per_unit: Positive | None = None
    full_scale: Positive
    range_kpa: Positive
    nominal_rate_hz: float = Field(gt=0, le=10_000)

    @model_validator(mode="after")
    def _is_consistent(self) -> "LayoutDescription":
        self._check_pads()
        self._check_cells()
        known = self.unit in KPA_PER_UNIT or self.unit == NEWTON
        if known and self.kpa_per_unit is not None:
            raise ValueError(
                f"kpa_per_unit: got {self.kpa_per_unit:g} for the unit {self.unit!r}, whose scale "
                "is known; expected none"
            )
        return self

    def _check_pads(self) -> None:
        order = [PADS.index(pad.part) for pad in self.pads]
        if order != sorted(set(order)):
            raise ValueError(
                f"pads: got {[pad.part for pad in self.pads]}, expected each part at most once, in "
                f"the order {', '.join(PADS)}"
            )
        if self.canvas[0] * self.canvas[1] > MAX_CELLS:
            raise ValueError(
                f"canvas: got {self.canvas}, expected at most {MAX_CELLS} cells in all"
            )
        drawn: set[tuple[int, int]] = set()
        for pad in self.pads:
            row, column = pad.origin
            if row + pad.rows > self.canvas[0] or column + pad.columns > self.canvas[1]:
                raise ValueError(
                    f"pads: {pad.part} of {pad.shape} at {pad.origin} ends outside of the canvas, "
                    f"expected it within {self.canvas}"
                )
            rows, columns = range(row, row + pad.rows), range(column, column + pad.columns)
            cells = set(itertools.product(rows, columns))
            if drawn & cells:
                raise ValueError(
                    f"pads: {pad.part} at {pad.origin} lies over another pad on the canvas, "
                    "expected a place of its own"
                )
            drawn |= cells

    def _check_cells(self) -> None:
        for side, cells in (("left", self.raw_cells.left), ("right", self.raw_cells.right)):
            where = f"raw_cells.{side}"
            if len(cells) != self.num_taxels:
                raise ValueError(
                    f"{where}: got {len(cells)} cells, expected {self.num_taxels}, one for each "
                    "taxel of the pads"
                )
            if (highest := max(cells)) >= self.num_raw_cells:
                raise ValueError(
                    f"{where}: got cell {highest} for taxel {cells.index(highest)}, expected "
                    f"0 … {self.num_raw_cells - 1} (num_raw_cells)"
                )
            cell, count = Counter(cells).most_common(1)[0]
            if count > 1:
                raise ValueError(
                    f"{where}: got cell {cell} for {count} taxels, expected a cell of its own for "
                    "each"
                )

    # Worlds compare it with every chunk.
    @cached_property
    def num_taxels(self) -> int:
        """Taxels of one hand."""
        return sum(pad.num_taxels for pad in self.pads)

    @property
    def fingers(self) -> tuple[TactilePad, ...]:
        """The pads of fingers."""
        return tuple(pad for pad in self.pads if pad.part != "palm")

    @property
    def palm(self) -> TactilePad | None:
        """The pad of the palm; None of a glove without one."""
        return self.pads[-1] if self.pads[-1].part == "palm" else None

    @property
    def num_finger_taxels(self) -> int:
        """Taxels of the fingers, which come before those of the palm."""
        return sum(pad.num_taxels for pad in self.fingers)

    @property
    def starts(self) -> tuple[int, ...]:
        """Number of the first taxel of each pad."""
        starts = [0]
        for pad in self.pads[:-1]:
            starts.append(starts[-1] + pad.num_taxels)
        return tuple(starts)

    def model_copy(
        self: DescriptionT, *, update: Mapping[str, Any] | None = None, deep: bool = False
    ) -> DescriptionT:
        """A copy with other fields, validated; what is cached is computed anew."""
        del deep
        return type(self).model_validate(self.model_dump() | dict(update or {}))

    # Not field by field as pydantic does, whose comparison includes what is cached: arrays.
    def __eq__(self, other: object) -> bool:
        return isinstance(other, LayoutDescription) and self.fingerprint == other.fingerprint

    def __hash__(self) -> int:
        return hash(self.fingerprint)

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of all that the layout says; equal layouts have equal ones."""
        return hashlib.sha256(json.dumps(self.model_dump(), sort_keys=True).encode()).hexdigest()


def _of_text(value: object) -> object:
    if not isinstance(value, str):
        return value
    if len(value) > MAX_LAYOUT_TEXT:
        raise ValueError(f"got {len(value)} letters, expected at most {MAX_LAYOUT_TEXT}")
    return from_json(value)


# A layout that messages hold as one JSON text: their lists have at most 1024 items, its cells 4096.
LayoutText = Annotated[
    LayoutDescription,
    BeforeValidator(_of_text),
    PlainSerializer(LayoutDescription.model_dump_json, return_type=str),
]
