"""Glove takes and the list of presses with known pressures."""

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from dextouch.errors import InvalidInputError
from dextouch.streams import SampleBatch
from services.alignment.calibration.tactile_gain import TaxelPress
from services.alignment.calibration.tactile_glove_calibration import pad_taxels
from services.cli.calibrate.poses import read_rows
from services.cli.calibrate.takes import read_stream

STANDARD_GRAVITY_M_S2 = 9.80665
EXPECTED = (
    "CSV with the columns take and pressure_kpa, or mass_kg and area_cm2; optional are sigma_kpa, "
    "pads, start_s, stop_s"
)


class PressRow(BaseModel):
    """One row of the list of presses; `stop_s` None means the end of the take.

    Instead of `pressure_kpa`, a weight may be given by `mass_kg` and `area_cm2`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    take: str
    pressure_kpa: float = Field(gt=0)
    sigma_kpa: float | None = Field(default=None, ge=0)
    pads: str = "all"
    start_s: float = 0.0
    stop_s: float | None = None

    @model_validator(mode="before")
    @classmethod
    def _pressure_of_weight(cls, given: dict[str, Any]) -> dict[str, Any]:
        weight = {"mass_kg", "area_cm2"}
        if not weight & given.keys():
            return given
        if "pressure_kpa" in given:
            raise ValueError("got pressure_kpa and a weight, expected one of the two")
        mass_kg, area_cm2 = float(given.get("mass_kg", 0)), float(given.get("area_cm2", 0))
        if not (mass_kg > 0 and area_cm2 > 0):
            raise ValueError("expected mass_kg and area_cm2, both above 0")
        pressure_kpa = mass_kg * STANDARD_GRAVITY_M_S2 / (area_cm2 * 1e-4) / 1e3
        others = {name: value for name, value in given.items() if name not in weight}
        return {**others, "pressure_kpa": pressure_kpa}

    def known_to(self, relative_sigma: float) -> "PressRow":
        """The row with a sigma; without one of its own, a share of the pressure."""
        if self.sigma_kpa is not None:
            return self
        return self.model_copy(update={"sigma_kpa": relative_sigma * self.pressure_kpa})


def read_presses(path: Path, relative_sigma: float) -> list[PressRow]:
    """Read the list of presses; takes beside the file may be named by their folder alone.

    Raises:
        NotFoundError: no such file.
        InvalidInputError: invalid columns or numbers.
    """
    rows = []
    for row in read_rows(path, PressRow, "press", EXPECTED):
        beside = path.parent / row.take
        take = str(beside) if beside.is_dir() else row.take
        rows.append(row.known_to(relative_sigma).model_copy(update={"take": take}))
    return rows


def read_take(take: str, options: argparse.Namespace) -> SampleBatch:
    """Readings of one glove from a spool folder, or from a recording of the store.

    Raises:
        NotFoundError: no such take, or without this glove.
        InvalidInputError: the stream holds pressures, not counts.
    """
    taken = read_stream(take, f"tactile_{options.side}", options.store)
    if taken.descriptor.unit != "counts":
        raise InvalidInputError(
            f"take {take!r}: {taken.descriptor.name} is in {taken.descriptor.unit}, expected raw "
            "counts"
        )
    return taken.batch


def press_of(row: PressRow, options: argparse.Namespace) -> TaxelPress:
    """The readings of one press.

    Raises:
        NotFoundError: no such take, or without this glove.
        UnknownNameError: no such pad.
        InvalidInputError: pressures instead of counts.
    """
    batch = read_take(row.take, options)
    t_s = (batch.t_host_ns - batch.t_host_ns[:1]) * 1e-9
    wanted = t_s >= row.start_s
    if row.stop_s is not None:
        wanted &= t_s < row.stop_s
    taxels = pad_taxels(row.pads)
    return TaxelPress(row.pressure_kpa, row.sigma_kpa or 0.0, batch.values[wanted], taxels)


def write_presses(path: Path, rows: Sequence[PressRow]) -> None:
    """Write the list for `read_presses`, so that a calibration can be repeated."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["take", "pressure_kpa", "sigma_kpa", "pads"])
        writer.writerows([row.take, row.pressure_kpa, row.sigma_kpa, row.pads] for row in rows)
