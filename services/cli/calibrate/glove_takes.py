"""Glove takes and the list of presses with known pressures."""

import argparse
import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.streams import SampleBatch
from services.alignment.calibration.tactile_gain import TaxelPress
from services.alignment.calibration.tactile_glove_calibration import pad_taxels
from services.cli.calibrate.takes import read_stream

STANDARD_GRAVITY_M_S2 = 9.80665
COLUMNS = ("take", "pressure_kpa", "sigma_kpa", "pads", "mass_kg", "area_cm2", "start_s", "stop_s")


@dataclass(frozen=True)
class PressRow:
    """One row of the list of presses; `stop_s` None means the end of the take."""

    take: str
    pressure_kpa: float
    sigma_kpa: float
    pads: str
    start_s: float
    stop_s: float | None


def read_presses(path: Path, relative_sigma: float) -> list[PressRow]:
    """Read a CSV with the columns `take` and either `pressure_kpa` or `mass_kg` with `area_cm2`.

    Raises:
        NotFoundError: no such file.
        InvalidInputError: invalid columns or numbers.
    """
    if not path.is_file():
        raise NotFoundError(f"{path}: no such list of presses")
    try:
        return _read_rows(path, relative_sigma)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidInputError(
            f"{path}: no CSV in UTF-8 ({error}); expected the columns {', '.join(COLUMNS)}"
        ) from error


def _read_rows(path: Path, relative_sigma: float) -> list[PressRow]:
    with path.open(encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file, skipinitialspace=True)
        names = set(reader.fieldnames or ())
        if "take" not in names or names - set(COLUMNS):
            raise InvalidInputError(
                f"{path}: got columns {sorted(names)}, expected take and some of "
                f"{', '.join(COLUMNS[1:])}"
            )
        rows = []
        for row in reader:
            where = f"{path}: line {reader.line_num}"
            try:
                rows.append(press_row(row, relative_sigma, path.parent))
            except (TypeError, ValueError) as error:
                raise InvalidInputError(f"{where}: {error}") from error
    if not rows:
        raise InvalidInputError(f"{path}: holds no press")
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


def press_row(row: dict[str, str], relative_sigma: float, folder: Path) -> PressRow:
    """Parse one row of the list.

    Args:
        row: as `COLUMNS`.
        relative_sigma: default relative sigma of a pressure.
        folder: base of relative take paths.

    Raises:
        ValueError: missing or invalid numbers.
    """
    take = row["take"]
    if take and (folder / take).is_dir():
        take = str(folder / take)
    if row.get("pressure_kpa") and (row.get("mass_kg") or row.get("area_cm2")):
        raise ValueError("got pressure_kpa and a weight, expected one of the two")
    if row.get("pressure_kpa"):
        pressure_kpa = float(row["pressure_kpa"])
    elif row.get("mass_kg") and row.get("area_cm2"):
        force_n = float(row["mass_kg"]) * STANDARD_GRAVITY_M_S2
        pressure_kpa = force_n / (float(row["area_cm2"]) * 1e-4) / 1e3
    else:
        raise ValueError("expected pressure_kpa, or mass_kg and area_cm2")
    given = row.get("sigma_kpa")
    sigma_kpa = float(given) if given else relative_sigma * pressure_kpa
    stop = row.get("stop_s")
    return PressRow(
        take,
        pressure_kpa,
        sigma_kpa,
        row.get("pads") or "all",
        float(row.get("start_s") or 0.0),
        float(stop) if stop else None,
    )


def press_of(row: PressRow, options: argparse.Namespace) -> TaxelPress:
    """The readings of one press.

    Raises:
        NotFoundError: no such take, or without this glove.
        UnknownNameError: no such pad.
        InvalidInputError: no pressure above 0, or pressures instead of counts.
    """
    batch = read_take(row.take, options)
    t_s = (batch.t_host_ns - batch.t_host_ns[:1]) * 1e-9
    wanted = t_s >= row.start_s
    if row.stop_s is not None:
        wanted &= t_s < row.stop_s
    return TaxelPress(row.pressure_kpa, row.sigma_kpa, batch.values[wanted], pad_taxels(row.pads))


def write_presses(path: Path, rows: Sequence[PressRow]) -> None:
    """Write the list for `read_presses`, so that a calibration can be repeated."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["take", "pressure_kpa", "sigma_kpa", "pads"])
        writer.writerows([row.take, row.pressure_kpa, row.sigma_kpa, row.pads] for row in rows)
