"""Command `dextouch station calibrate glove`: tare, gain and fault map of the taxels."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dextouch.command_line import progress
from dextouch.errors import InvalidInputError
from services.alignment.calibration.tactile_faults import OK, STATES
from services.alignment.calibration.tactile_glove_calibration import (
    GloveCalibration,
    calibrate_glove,
)
from services.alignment.calibration.tactile_tare import measure_tare
from services.cli.calibrate.glove_takes import (
    PressRow,
    press_of,
    read_presses,
    read_take,
    record_takes,
)
from services.cli.calibrate.pictures import glove_picture
from services.cli.calibrate.record import MATRICES_FILE, write_entry, write_picture


def calibrate(options: argparse.Namespace) -> dict[str, object]:
    """Calibrate the tare of one glove, and with presses its gain and fault map.

    Raises:
        InvalidInputError: unsuitable takes or pressures; the message says what to do.
        NotFoundError: no such take, or it has no readings of this glove.
    """
    side = options.side
    rest, rows = _takes(options)
    tare = measure_tare(read_take(rest, options).values, side=side)
    presses = [press_of(row, options) for row in progress(rows, "reading presses", len(rows))]
    found = calibrate_glove(tare, presses, full_scale_counts=options.full_scale)
    picture = write_picture(options.to, f"glove_{side}.svg", glove_picture(found))
    report = _facts(found, rest, rows)
    _keep(found, options.to, report)
    _tell(report, picture)
    if options.url is not None:
        path = (options.to / MATRICES_FILE).resolve()
        print(f"Restart the station with DEXTOUCH_ACQUISITION_CALIBRATION={path}")
    return report


def _takes(options: argparse.Namespace) -> tuple[str, Sequence[PressRow]]:
    """The rest take and the presses, either given or recorded now by a station."""
    if options.url is not None:
        if options.rest is not None or options.presses is not None:
            raise InvalidInputError(
                "got --url and --rest or --presses, expected one of the two: a station records its "
                "takes now, or takes are named that are there"
            )
        return record_takes(options)
    if options.rest is None:
        raise InvalidInputError(
            "expected --url of a running station, which records what is needed, or --rest TAKE"
        )
    rows = read_presses(options.presses, options.pressure_sigma) if options.presses else []
    return options.rest, rows


def _facts(found: GloveCalibration, rest: str, rows: Sequence[PressRow]) -> dict[str, object]:
    level = found.tare.level
    facts: dict[str, object] = {
        "side": found.tare.side,
        "rest_take": rest,
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
    """Write tare and gain as separate entries, so that a daily tare keeps the gain."""
    side, matrices = found.tare.side, found.matrices()
    zero = {name: m for name, m in matrices.items() if "_tare_" in name or "_noise_" in name}
    write_entry(folder, f"tactile_{side}_tare", zero, facts)
    rest = {name: m for name, m in matrices.items() if name not in zero}
    if rest:
        write_entry(folder, f"tactile_{side}_gain", rest, facts)


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
