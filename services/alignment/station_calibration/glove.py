"""Calibration of a glove: tare, gain and fault map, from takes or what a station records now."""

import argparse
import csv
import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from dextouch.clients import HttpLink
from dextouch.command_line import progress
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.streams import TAXEL_UNIT
from dextouch.tactile.layout import TactileLayout
from services.alignment.calibration.tactile_gain import (
    TaxelGain,
    TaxelPress,
    calibrate_glove,
    fit_gain,
    pad_taxels,
)
from services.alignment.calibration.tactile_tare import (
    OK,
    STATES,
    TaxelTare,
    measure_tare,
    reading_step,
)
from services.alignment.station_calibration.camera_views import glove_picture
from services.alignment.station_calibration.record import (
    MATRICES_FILE,
    Ask,
    Question,
    Say,
    TakeRecorder,
    ask_at_terminal,
    read_rows,
    read_stream,
    write_entry,
    write_picture,
)

STANDARD_GRAVITY_M_S2 = 9.80665
REST_S, PRESS_S = 10.0, 5.0
TASK = "calibrate-glove"
COLUMNS = ("take", "pressure_kpa", "sigma_kpa", "pads")
EXPECTED = (
    "CSV with the columns take and pressure_kpa, or mass_kg and area_cm2; optional are sigma_kpa, "
    "pads, start_s, stop_s"
)
PRESS_HELP = "30, or 30 palm, or 30 thumb+index (kPa), or 2kg/90cm2 palm (a weight)"
NEXT = Question(
    "Next pressure",
    "Use this pressure",
    takes_text=True,
    choices=(("No more pressures", ""), ("Drop the last one", "drop")),
)
# Groups are named as the columns of the list of presses.
_PRESS = re.compile(
    r"(?:(?P<pressure_kpa>[0-9.]+)(?: ?kpa)?"
    r"|(?P<mass_kg>[0-9.]+) ?kg ?/ ?(?P<area_cm2>[0-9.]+) ?cm2)(?: +(?P<pads>[a-z+]+))?"
)


class PressRow(BaseModel):
    """A row of presses, by default of the whole take; a pressure, or mass_kg and area_cm2."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    take: str
    pressure_kpa: float = Field(gt=0)
    sigma_kpa: float | None = Field(default=None, ge=0)
    pads: str = "all"
    start_s: float = 0.0
    stop_s: float = math.inf

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
        return {n: v for n, v in given.items() if n not in weight} | {"pressure_kpa": pressure_kpa}

    def known_to(self, relative_sigma: float) -> "PressRow":
        """The row with a sigma, if none then a share, which must be 0 or more, of the pressure."""
        if not 0 <= relative_sigma < math.inf:
            raise InvalidInputError(
                f"pressure sigma: got {relative_sigma:g}, expected a share of the pressure, 0 or "
                "more, such as 0.02"
            )
        if self.sigma_kpa is not None:
            return self
        return self.model_copy(update={"sigma_kpa": relative_sigma * self.pressure_kpa})


def read_presses(path: Path, relative_sigma: float) -> list[PressRow]:
    """Read the list of presses; takes beside the file may be named by their folder alone."""
    rows = []
    for row in read_rows(path, PressRow, "press", EXPECTED):
        beside = path.parent / row.take
        take = str(beside) if beside.is_dir() else row.take
        rows.append(row.known_to(relative_sigma).model_copy(update={"take": take}))
    return rows


def write_presses(path: Path, rows: Sequence[PressRow]) -> None:
    """Write the list for `read_presses`, so that a calibration can be repeated."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerows([COLUMNS, *([getattr(row, name) for name in COLUMNS] for row in rows)])


def parse_press(words: str, relative_sigma: float) -> PressRow:
    """Parse a pressure typed by the operator (`PRESS_HELP`), before its take."""
    matched = _PRESS.fullmatch(words.strip().lower())
    groups = matched.groupdict() if matched else {}
    given = {name: text for name, text in groups.items() if text}
    try:
        row = PressRow.model_validate({"take": ""} | given)
    except ValidationError as error:
        raise InvalidInputError(
            f"pressure: got {words!r}, expected {PRESS_HELP}, above 0"
        ) from error
    pad_taxels(row.pads)
    return row.known_to(relative_sigma)


class GloveTake(NamedTuple):
    """Raw readings of one glove in counts (of other units: in steps of `reading_step`)."""

    t_host_ns: Int64[np.ndarray, " time"]
    counts: Float64[np.ndarray, "time cells"]
    layout: TactileLayout


def read_take(take: str, options: argparse.Namespace) -> GloveTake:
    """Raw readings of one glove from a spool folder, or from a recording of the store."""
    taken = read_stream(take, f"tactile_{options.side}", options.store)
    about = taken.descriptor
    if about.unit != "counts" and (about.layout is None or about.unit == TAXEL_UNIT):
        raise InvalidInputError(
            f"take {take!r}: {about.name} is in {about.unit}, expected raw counts, or a glove "
            "whose settings name its layout"
        )
    counts = np.asarray(taken.batch.values) / reading_step(about.tactile_layout)
    return GloveTake(taken.batch.t_host_ns, counts, about.tactile_layout)


def press_of(row: PressRow, options: argparse.Namespace) -> TaxelPress:
    """The readings of one press."""
    taken = read_take(row.take, options)
    t_s = (taken.t_host_ns - taken.t_host_ns[:1]) * 1e-9
    counts = taken.counts[(t_s >= row.start_s) & (t_s < row.stop_s)]
    taxels = pad_taxels(row.pads, taken.layout)
    return TaxelPress(row.pressure_kpa, row.sigma_kpa or 0.0, counts, taxels)


def tare_of(take: str, options: argparse.Namespace) -> TaxelTare:
    """The tare of a rest take."""
    taken = read_take(take, options)
    return measure_tare(taken.counts, side=options.side, layout=taken.layout)


def full_scale_counts(layout: TactileLayout, options: argparse.Namespace) -> float:
    """The largest count: that of the options, or of the layout if that is less."""
    return min(options.full_scale, layout.full_scale / reading_step(layout))


class Guide:
    """Leads an operator through rest and presses; an invalid take is explained and repeated."""

    def __init__(
        self,
        options: argparse.Namespace,
        recorder: TakeRecorder,
        *,
        ask: Ask = ask_at_terminal,
        say: Say = print,
    ) -> None:
        self._options, self._recorder, self._ask = options, recorder, ask
        self.say = say
        started = f"calibration-glove-{options.side}-{datetime.now(UTC):%Y%m%d-%H%M%S}"
        self._names = (f"{started}-{number}" for number in count(1))

    def rest(self) -> tuple[str, TaxelTare]:
        """Record a rest take with a valid tare."""
        side = self._options.side
        while True:
            self._answer(
                Question(
                    f"Lay the {side} glove down, untouched, and let it rest for a minute.",
                    f"Record {REST_S:g} s",
                )
            )
            try:
                return self._recorder.record(
                    next(self._names),
                    f"{side} glove at rest, untouched",
                    REST_S,
                    lambda take: tare_of(take, self._options),
                )
            except InvalidInputError as error:
                self.say(f"Once more: {error.message}")

    def presses(self, tare: TaxelTare) -> list[PressRow]:
        """Record presses until the operator is done."""
        self.say(
            f"Now two to four known pressures, the highest as high as work needs: {PRESS_HELP}."
        )
        known: list[tuple[PressRow, TaxelPress]] = []
        while answer := self._answer(NEXT).strip():
            if answer == "drop":
                known = known[:-1]
                self.say(f"{len(known)} presses are left")
                continue
            try:
                typed = parse_press(answer, self._options.pressure_sigma)
            except (InvalidInputError, UnknownNameError) as error:
                self.say(error.message)
                continue
            try:
                known.append(self._press(typed, tare))
            except InvalidInputError as error:
                self.say(f"Not used: {error.message}")
                continue
            self.say(self._known_so_far(tare, [press for _, press in known]))
        return [row for row, _ in known]

    def _press(self, pressure: PressRow, tare: TaxelTare) -> tuple[PressRow, TaxelPress]:
        target = f"{pressure.pressure_kpa:.4g} kPa on {pressure.pads}"
        self._answer(Question(f"Put {target} and hold still.", f"Record {PRESS_S:g} s"))

        def check(take: str) -> tuple[PressRow, TaxelPress]:
            row = pressure.model_copy(update={"take": take})
            press = press_of(row, self._options)
            fit_gain(tare, [press], full_scale_counts=self._full_scale(tare))
            return row, press

        return self._recorder.record(next(self._names), f"{target}, held still", PRESS_S, check)[1]

    def _known_so_far(self, tare: TaxelTare, presses: list[TaxelPress]) -> str:
        try:
            found = calibrate_glove(
                tare, presses, full_scale_counts=self._full_scale(tare)
            ).num_by_state()
        except InvalidInputError as error:
            return f"{len(presses)} presses, not enough yet: {error.message}"
        others = ", ".join(f"{n} {state}" for state, n in found.items() if state != "ok")
        return (
            f"{len(presses)} presses: {found['ok']} of {tare.layout.num_taxels} taxels known"
            f"{f' ({others})' if others else ''}; more pressures show bends, and a low one "
            "again at the end a drift"
        )

    def _full_scale(self, tare: TaxelTare) -> float:
        return full_scale_counts(tare.layout, self._options)

    def _answer(self, question: Question) -> str:
        try:
            return self._ask(question)
        except EOFError as error:
            raise InvalidInputError(
                "calibrate glove --url: nobody answers; run it at a terminal, or name takes with "
                "--rest and --presses"
            ) from error


def record_takes(
    options: argparse.Namespace, guide: Guide | None = None
) -> tuple[str, list[PressRow]]:
    """Lead an operator through rest and presses; returns the rest take and the presses."""
    if guide is None:
        link = HttpLink(options.url, api_key=options.key)
        recorder = TakeRecorder(link.request, TASK, spool=options.spool, store=options.store)
        guide = Guide(options, recorder)
    rest, tare = guide.rest()
    rows = guide.presses(tare)
    again = f"dextouch station calibrate glove --side {options.side} --rest {rest}"
    if rows:
        path = options.to / f"presses_{options.side}.csv"
        write_presses(path, rows)
        again += f" --presses {path}"
    guide.say(f"The same takes again: {again} --to {options.to}")
    return rest, rows


def calibrate(
    options: argparse.Namespace, guide: Guide | None = None, *, say: Say = print
) -> dict[str, object]:
    """Tare of a glove, with presses gain and fault map; raises InvalidInputError of bad takes."""
    side = options.side
    rest, rows = _takes(options, guide)
    tare = tare_of(rest, options)
    presses = [press_of(row, options) for row in progress(rows, "reading presses", len(rows))]
    found = calibrate_glove(
        tare, presses, full_scale_counts=full_scale_counts(tare.layout, options)
    )
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
