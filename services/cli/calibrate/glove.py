"""`dextouch station calibrate glove`: a rest take and presses in; tare, gain and faults out."""

import argparse
import csv
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from dextouch.episodes import EpisodeStore, RecordingReader
from dextouch.episodes.log import SpoolReader
from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.streams.samples import SampleBatch
from services.alignment.calibration.tactile_faults import OK, STATES
from services.alignment.calibration.tactile_gain import TaxelPress
from services.alignment.calibration.tactile_glove_calibration import (
    GloveCalibration,
    calibrate_glove,
    pad_taxels,
)
from services.alignment.calibration.tactile_tare import measure_tare
from services.cli.calibrate.photos import progress
from services.cli.calibrate.pictures import glove_picture
from services.cli.calibrate.record import write_entry, write_picture

STANDARD_GRAVITY_M_S2 = 9.80665
COLUMNS = ("take", "pressure_kpa", "sigma_kpa", "pads", "mass_kg", "area_cm2", "start_s", "stop_s")


@dataclass(frozen=True)
class PressRow:
    """One line of the list of presses; `stop_s` None means to the end of the take."""

    take: str
    pressure_kpa: float
    sigma_kpa: float
    pads: str
    start_s: float
    stop_s: float | None


def calibrate(options: argparse.Namespace) -> dict[str, object]:
    """Tare, and with presses gain and fault map, of one glove.

    Raises:
        InvalidInputError: takes or pressures that do not fit; the message says what to do.
        NotFoundError: no such take, or it has no readings of this glove.
    """
    side = options.side
    rows = read_presses(options.presses, options.pressure_sigma) if options.presses else []
    tare = measure_tare(read_take(options.rest, options).values, side=side)
    presses = [_press(row, options) for row in progress(rows, "reading presses")]
    found = calibrate_glove(tare, presses, full_scale_counts=options.full_scale)
    picture = write_picture(options.to, f"glove_{side}.svg", glove_picture(found))
    report = _facts(found, options, rows)
    _keep(found, options.to, report)
    _tell(report, picture)
    return report


def read_presses(path: Path, relative_sigma: float) -> list[PressRow]:
    """Lines of a CSV: `take` and either `pressure_kpa` or `mass_kg` with `area_cm2`.

    Raises:
        NotFoundError: no such file.
        InvalidInputError: columns or numbers that do not fit.
    """
    if not path.is_file():
        raise NotFoundError(f"{path}: no such list of presses")
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
                rows.append(_press_row(row, relative_sigma, path.parent))
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
    name = f"tactile_{options.side}"
    reader: SpoolReader | RecordingReader
    if Path(take).is_dir():
        reader = SpoolReader(Path(take))
    elif options.store:
        reader = EpisodeStore(options.store).recording(take)
    else:
        raise NotFoundError(
            f"take {take!r}: no such folder; name a take of the station's spool, or add --store "
            "URL for the id of a recording"
        )
    streams = reader.streams
    if name not in streams:
        raise NotFoundError(f"take {take!r}: has no {name!r}, only {', '.join(sorted(streams))}")
    if streams[name].unit != "counts":
        raise InvalidInputError(
            f"take {take!r}: {name} is in {streams[name].unit}, expected raw counts"
        )
    return reader.read(name)


def _press_row(row: dict[str, str], relative_sigma: float, folder: Path) -> PressRow:
    take = row["take"]
    if (folder / take).is_dir():
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


def _press(row: PressRow, options: argparse.Namespace) -> TaxelPress:
    batch = read_take(row.take, options)
    t_s = (batch.t_host_ns - batch.t_host_ns[:1]) * 1e-9
    wanted = t_s >= row.start_s
    if row.stop_s is not None:
        wanted &= t_s < row.stop_s
    return TaxelPress(row.pressure_kpa, row.sigma_kpa, batch.values[wanted], pad_taxels(row.pads))


def _facts(
    found: GloveCalibration, options: argparse.Namespace, rows: list[PressRow]
) -> dict[str, object]:
    level = found.tare.level
    facts: dict[str, object] = {
        "side": options.side,
        "rest_take": str(options.rest),
        "num_rest_readings": found.tare.num_samples,
        "tare_median_counts": float(np.median(level.mean_counts)),
        "tare_sigma_median_counts": float(np.median(level.sigma_counts)),
        "noise_median_counts": float(np.median(level.noise_counts)),
        "restless_taxels": np.flatnonzero(found.tare.restless).tolist(),
    }
    if found.gain is None:
        return facts
    gain, good = found.gain, found.gain.state == OK
    relative = gain.sigma_counts_per_kpa[good] / gain.gain_counts_per_kpa[good]
    return facts | {
        "presses": [[row.take, row.pressure_kpa, row.sigma_kpa, row.pads] for row in rows],
        "gain_median_counts_per_kpa": float(np.median(gain.gain_counts_per_kpa[good])),
        "gain_sigma_median_ratio": float(np.median(relative)),
        "residual_rms_kpa": float(np.sqrt(np.mean(gain.residual_kpa[:, good] ** 2))),
        "num_by_state": found.num_by_state(),
        "taxels_by_state": {
            STATES[state]: np.flatnonzero(gain.state == state).tolist()
            for state in np.unique(gain.state)
            if state != OK
        },
    }


def _keep(found: GloveCalibration, folder: Path, facts: dict[str, object]) -> None:
    """Tare and gain are entries of their own: a daily tare leaves the gain as it was."""
    side, now = found.tare.side, datetime.now(UTC)
    matrices = found.matrices()
    zero = {name: m for name, m in matrices.items() if "_tare_" in name or "_noise_" in name}
    write_entry(folder, entry=f"tactile_{side}_tare", matrices=zero, facts=facts, now=now)
    rest = {name: m for name, m in matrices.items() if name not in zero}
    if rest:
        write_entry(folder, entry=f"tactile_{side}_gain", matrices=rest, facts=facts, now=now)


def _tell(report: dict[str, object], picture: Path) -> None:
    print(
        f"tare of the {report['side']} glove: median {report['tare_median_counts']:.1f} ± "
        f"{report['tare_sigma_median_counts']:.2f} counts, noise of a reading "
        f"{report['noise_median_counts']:.1f} counts, {report['num_rest_readings']} readings"
    )
    if "gain_median_counts_per_kpa" in report:
        print(
            f"gain: median {report['gain_median_counts_per_kpa']:.2f} counts/kPa, each known to "
            f"{report['gain_sigma_median_ratio']:.1%}; presses fit to "
            f"{report['residual_rms_kpa']:.2f} kPa RMS"
        )
        faulty = report["taxels_by_state"]
        for state, taxels in faulty.items() if isinstance(faulty, dict) else ():
            print(f"  {state}: {len(taxels)} taxels ({', '.join(str(t) for t in taxels[:12])} …)")
    else:
        print("no presses: the gain, if there is one, stays as it was")
    print(f"picture: {picture}")
