"""Calibration of a glove: tare, gain and fault map of the taxels, from takes."""

import argparse
from collections.abc import Sequence

import numpy as np

from dextouch.command_line import progress
from dextouch.errors import InvalidInputError
from services.alignment.calibration.tactile_gain import TaxelGain, calibrate_glove
from services.alignment.calibration.tactile_tare import OK, STATES, TaxelTare, measure_tare
from services.alignment.station_calibration.camera_views import glove_picture
from services.alignment.station_calibration.glove_takes import (
    Guide,
    PressRow,
    Say,
    press_of,
    read_presses,
    read_take,
    record_takes,
)
from services.alignment.station_calibration.record import MATRICES_FILE, write_entry, write_picture


def calibrate(
    options: argparse.Namespace, guide: Guide | None = None, *, say: Say = print
) -> dict[str, object]:
    """Calibrate the tare of one glove, and with presses its gain and fault map.

    Raises:
        InvalidInputError: unsuitable takes or pressures; the message says what to do.
    """
    side = options.side
    rest, rows = _takes(options, guide)
    tare = measure_tare(read_take(rest, options).values, side=side)
    presses = [press_of(row, options) for row in progress(rows, "reading presses", len(rows))]
    found = calibrate_glove(tare, presses, full_scale_counts=options.full_scale)
    picture = write_picture(options.to, f"glove_{side}.svg", glove_picture(found))
    facts: dict[str, object] = {"side": side, "rest_take": rest, **_tare_facts(tare, say)}
    if found.gain is not None:
        facts["presses"] = [[row.take, row.pressure_kpa, row.sigma_kpa, row.pads] for row in rows]
        facts |= {"num_by_state": found.num_by_state(), **_gain_facts(found.gain, say)}
    else:
        say("no presses: the gain, if there is one, stays as it was")
    # Tare and gain are separate entries, so that a daily tare keeps the gain.
    matrices = found.matrices()
    zero = {name: m for name, m in matrices.items() if "_tare_" in name or "_noise_" in name}
    write_entry(options.to, f"tactile_{side}_tare", zero, facts)
    rest_of_all = {name: m for name, m in matrices.items() if name not in zero}
    if rest_of_all:
        write_entry(options.to, f"tactile_{side}_gain", rest_of_all, facts)
    say(f"picture: {picture}")
    if options.url is not None:
        path = (options.to / MATRICES_FILE).resolve()
        say(f"Restart the station with DEXTOUCH_ACQUISITION_CALIBRATION={path}")
    return facts


def _takes(options: argparse.Namespace, guide: Guide | None) -> tuple[str, Sequence[PressRow]]:
    """The rest take and the presses, either given or recorded now by a station."""
    if options.url is not None:
        if options.rest is not None or options.presses is not None:
            raise InvalidInputError(
                "got --url and --rest or --presses, expected one of the two: a station records its "
                "takes now, or takes are named that are there"
            )
        return record_takes(options, guide)
    if options.rest is None:
        raise InvalidInputError(
            "expected --url of a running station, which records what is needed, or --rest TAKE"
        )
    rows = read_presses(options.presses, options.pressure_sigma) if options.presses else []
    return options.rest, rows


def _tare_facts(tare: TaxelTare, say: Say) -> dict[str, object]:
    """Print and return what a tare says."""
    level = tare.level
    median, sigma, noise = (
        float(np.median(counts))
        for counts in (level.mean_counts, level.sigma_counts, level.noise_counts)
    )
    say(
        f"tare of the {tare.side} glove: median {median:.1f} ± {sigma:.2f} counts, noise of a "
        f"reading {noise:.1f} counts, {tare.num_samples} readings"
    )
    return {
        "num_rest_readings": tare.num_samples,
        "tare_median_counts": median,
        "tare_sigma_median_counts": sigma,
        "noise_median_counts": noise,
        "restless_taxels": np.flatnonzero(tare.restless).tolist(),
    }


def _gain_facts(gain: TaxelGain, say: Say) -> dict[str, object]:
    """Print and return what a gain says."""
    good = gain.state == OK
    median = float(np.median(gain.gain_counts_per_kpa[good]))
    ratio = float(np.median(gain.sigma_counts_per_kpa[good] / gain.gain_counts_per_kpa[good]))
    rms_kpa = float(np.sqrt(np.mean(gain.residual_kpa[:, good] ** 2)))
    faulty = {
        STATES[state]: np.flatnonzero(gain.state == state).tolist()
        for state in np.unique(gain.state[~good])
    }
    say(
        f"gain: median {median:.2f} counts/kPa, each known to {ratio:.1%}; presses fit to "
        f"{rms_kpa:.2f} kPa RMS"
    )
    for state, taxels in faulty.items():
        say(f"  {state}: {len(taxels)} taxels ({', '.join(str(t) for t in taxels[:12])} …)")
    return {
        "gain_median_counts_per_kpa": median,
        "gain_sigma_median_ratio": ratio,
        "residual_rms_kpa": rms_kpa,
        "taxels_by_state": faulty,
    }
