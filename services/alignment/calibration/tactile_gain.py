"""Calibration of one glove from presses of known pressure: gain and state of each taxel."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from dextouch.errors import InvalidInputError, NonFiniteError, UnknownNameError
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout
from services.alignment.calibration.tactile_tare import (
    DEAD,
    FULL_SCALE_COUNTS,
    IMPRECISE,
    MIN_MOVE_COUNTS,
    NONLINEAR,
    OK,
    SATURATED,
    SATURATED_RATIO,
    SILENT_RATIO,
    STATES,
    UNPROVEN,
    Level,
    TaxelTare,
    checked_counts,
    classify_taxels,
    kind_of_silence,
    reading_step,
    steady_level,
)

# A reading at the stop says nothing about the pressure; so few of them are knocks. So many taxels
# that are noisy at rest, and all at the highest reading for most of a press, are at a stop, too.
MAX_SATURATED_READINGS = 0.01
MIN_AT_STOP = 5
# A pad that is not named may show this part of what those show that are: more is pressed.
MAX_OTHERS = 0.25
# Full scales of gloves of one layout differ by some 10 %. Pressures in psi are 6.9 times off.
MAX_RANGE_RATIO = 5.0
# Below this highest pressure the straight line is not seen, however low the noise.
MIN_RANGE_KPA = 5.0
MAX_RELATIVE_SIGMA = 0.1
# Deviation from the straight line, as a part of the largest response and in sigmas.
MAX_NONLINEARITY = 0.05
MIN_NONLINEARITY_SIGMAS = 3.0
MIN_POINTS_FOR_LINE = 3
ROUNDS = 4
# A trend of all taxels over pressure or time counts from so many standard deviations on; pressures
# are trusted to a part in five hundred at best.
MIN_TREND_SIGMAS = 2.0
MIN_PRESSURE_SIGMA = 2e-3
# A trend that differs by less from a straight line through zero cannot be told from a gain.
MIN_TREND_SHARE = 0.05
# Pressures of a taxel that differ by less are as one: they do not show how it bends.
MIN_PRESSURE_RATIO = 1.25
# Between the halves of a press the counts may creep by this part of the response.
MAX_CREEP = 0.1
MAX_CREEPING = 0.25
# More faulty taxels than this, and the glove needs a repair, not a calibration.
MAX_FAULTY = 0.25


@dataclass(frozen=True)
class TaxelPress:
    """A take [T ≥ 60, cells] under a pressure above 0 kPa on some taxels, with its sigma.

    Raises InvalidInputError: another pressure, or no taxel; NonFiniteError: NaN or infinity.
    """

    pressure_kpa: float
    sigma_kpa: float
    counts: np.ndarray
    taxels: Bool[np.ndarray, " taxels"]

    def __post_init__(self) -> None:
        if not np.isfinite([self.pressure_kpa, self.sigma_kpa]).all():
            raise NonFiniteError("press: pressure or sigma is not finite")
        if self.pressure_kpa <= 0 or self.sigma_kpa < 0 or not self.taxels.any():
            raise InvalidInputError(
                f"press: got {self.pressure_kpa:g} ± {self.sigma_kpa:g} kPa on "
                f"{int(self.taxels.sum())} taxels, expected above 0 on at least one"
            )


@dataclass(frozen=True)
class TaxelGain:
    """Gain of each taxel in counts per kPa, anatomical order; where refused, gain and sigma are 0.

    Attributes:
        sigma_counts_per_kpa: includes errors of the pressures, creep while a press lies, and a bend
            over pressure or a drift from press to press; of a single pressure the largest bend that
            is tolerated.
        state: index into `tactile_tare.STATES`.
        residual_kpa: [press, taxels] what each press is off the line, 0 where not used.
    """

    gain_counts_per_kpa: Float64[np.ndarray, " taxels"]
    sigma_counts_per_kpa: Float64[np.ndarray, " taxels"]
    state: UInt8[np.ndarray, " taxels"]
    residual_kpa: Float64[np.ndarray, "press taxels"]


@dataclass(frozen=True)
class GloveCalibration:
    """Calibration of one glove; `gain` is None if only the tare was measured."""

    tare: TaxelTare
    gain: TaxelGain | None

    def matrices(self) -> dict[str, Float64[np.ndarray, "1 cells"]]:
        """Matrices by their names in recordings, in scan order and in the unit of the readings.

        A taxel whose gain was refused gets the median gain of its pad, cells without a taxel that
        of all; `…_state` says which taxels (index into `tactile_tare.STATES`).
        """
        side, step = self.tare.side, reading_step(self.tare.layout)
        found = {
            f"tactile_{side}_tare_counts": step * self.tare.level.mean_counts,
            f"tactile_{side}_tare_sigma_counts": step * self.tare.level.sigma_counts,
            f"tactile_{side}_noise_counts": step * self.tare.level.noise_counts,
        }
        if self.gain is not None:
            layout = self.tare.layout
            filled = filled_gain(self.gain, layout)
            raw = np.full(layout.num_raw_cells, np.median(filled))
            raw[layout.raw_indices(side)] = filled
            sigma = layout.expand(self.gain.sigma_counts_per_kpa, side=side)
            state = layout.expand(self.gain.state, side=side)
            found |= {
                f"tactile_{side}_gain_counts_per_kpa": step * raw,
                f"tactile_{side}_gain_sigma_counts_per_kpa": step * sigma,
                f"tactile_{side}_taxel_state": state.astype(np.float64),
            }
        return {name: np.asarray(row, dtype=np.float64)[None] for name, row in found.items()}

    def num_by_state(self) -> dict[str, int]:
        """Number of taxels in each state that occurs."""
        if self.gain is None:
            return {}
        counts = np.bincount(self.gain.state, minlength=len(STATES))
        return {name: int(n) for name, n in zip(STATES, counts, strict=True) if n}


def calibrate_glove(
    tare: TaxelTare,
    presses: Sequence[TaxelPress],
    *,
    full_scale_counts: float = FULL_SCALE_COUNTS,
) -> GloveCalibration:
    """Gain and fault map of a glove, beside its tare; without presses the tare alone.

    Raises InvalidInputError: as `fit_gain`, or more than a quarter of the taxels is not OK.
    """
    if not presses:
        return GloveCalibration(tare, None)
    found = GloveCalibration(tare, fit_gain(tare, presses, full_scale_counts=full_scale_counts))
    counted = found.num_by_state()
    num_taxels = tare.layout.num_taxels
    if 1 - counted.get("ok", 0) / num_taxels > MAX_FAULTY:
        states = ", ".join(f"{number} {name}" for name, number in counted.items())
        raise InvalidInputError(
            f"glove {tare.side}: of {num_taxels} taxels {states}; expected at most "
            f"{MAX_FAULTY:.0%} not ok. Unproven: press them too. Imprecise: press harder, at least "
            "5 kPa. Saturated: press less. Nonlinear: let each press settle. Dead or stuck: repair "
            "the glove",
            num_by_state=counted,
        )
    return found


def filled_gain(
    gain: TaxelGain, layout: TactileLayout = DEXTOUCH_V1
) -> Float64[np.ndarray, " taxels"]:
    """Gains with the median of pad or glove for refused taxels; raises InvalidInputError."""
    known = gain.state == OK
    if not known.any():
        raise InvalidInputError("glove: the gain of no taxel is known")
    filled = gain.gain_counts_per_kpa.copy()
    usual_of_all = np.median(gain.gain_counts_per_kpa[known])
    for pad in _slices(layout).values():
        mine = known[pad]
        usual = np.median(gain.gain_counts_per_kpa[pad][mine]) if mine.any() else usual_of_all
        filled[pad] = np.where(mine, filled[pad], usual)
    return filled


def _slices(layout: TactileLayout) -> dict[str, slice]:
    starts = zip(layout.pads, layout.starts, strict=True)
    return {pad.part: slice(start, start + pad.num_taxels) for pad, start in starts}


def pad_taxels(names: str, layout: TactileLayout = DEXTOUCH_V1) -> Bool[np.ndarray, " taxels"]:
    """Taxels of pads such as `thumb+index`, or `all`; raises UnknownNameError for no such pad."""
    taxels, slices = np.zeros(layout.num_taxels, dtype=np.bool_), _slices(layout)
    for name in names.split("+"):
        if name == "all":
            taxels[:] = True
        elif name in slices:
            taxels[slices[name]] = True
        else:
            raise UnknownNameError("pad", name, [*slices, "all"])
    return taxels


def fit_gain(
    tare: TaxelTare,
    presses: Sequence[TaxelPress],
    *,
    full_scale_counts: float = FULL_SCALE_COUNTS,
) -> TaxelGain:
    """Weighted straight line of counts over pressure through each taxel's tare.

    Taxels that do not answer, saturate in all presses, bend, or were pressed too little for 10 % of
    gain are refused. Raises InvalidInputError: no press, no taxel that answers, counts that fall
    under pressure, pads that are pressed and not named, pressures that do not belong to the takes,
    or that make a full scale five times off the layout's, or a glove that bends or drifts by above
    10 %.
    """
    if not presses:
        raise InvalidInputError("gain: got no press, expected at least one known pressure")
    points = _points(tare, presses, full_scale_counts)
    _check_direction(points)
    takes = [press.counts for press in presses]
    state = classify_taxels(takes, tare, full_scale_counts=full_scale_counts)
    silent = _silent_under_pressure(points) & (state != SATURATED)
    state[silent] = kind_of_silence(takes, tare)[silent]
    pressed = points.used[:-1].any(axis=0)
    state[points.saturated[:-1].any(axis=0) & ~pressed] = SATURATED
    state[~pressed & (state == OK)] = UNPROVEN
    state[pressed & (state == UNPROVEN)] = OK
    gain, sigma, zero, excess = _lines(points)
    precise = gain[(state == OK) & (sigma < MAX_RELATIVE_SIGMA * gain)]
    _check_range(precise, tare.layout, full_scale_counts)
    # How long a touch lasts is not known, hence neither what it has crept: that is an error.
    creep = float(np.median([abs(_creep(press, tare)) for press in presses]))
    sigma = np.hypot(sigma, gain * np.hypot(creep, _trend(points, gain, state == OK)))
    state = _judge_lines(points, (gain, sigma, excess), state)
    good = state == OK
    line = zero + gain * points.pressure_kpa[:-1]
    safe = np.where(good, gain, 1.0)
    residual_kpa = np.where(points.used[:-1] & good, (points.counts[:-1] - line) / safe, 0.0)
    return TaxelGain(np.where(good, gain, 0.0), np.where(good, sigma, 0.0), state, residual_kpa)


@dataclass(frozen=True)
class _Points:
    """Levels of all presses and the rest take: rows 0 … K−1 presses, row K the tare."""

    pressure_kpa: Float64[np.ndarray, "k 1"]
    sigma_kpa: Float64[np.ndarray, "k 1"]
    counts: Float64[np.ndarray, "k taxels"]
    sigma_counts: Float64[np.ndarray, "k taxels"]
    used: Bool[np.ndarray, "k taxels"]
    saturated: Bool[np.ndarray, "k taxels"]


def _points(tare: TaxelTare, presses: Sequence[TaxelPress], full_scale_counts: float) -> _Points:
    limit = SATURATED_RATIO * full_scale_counts
    rows = []

    def of_taxels(level: Level) -> list[np.ndarray]:
        rows = level.mean_counts, level.sigma_counts
        return [tare.select(row) for row in rows]

    for index, press in enumerate(presses):
        what = f"press {index} ({press.pressure_kpa:g} kPa)"
        raw = checked_counts(press.counts, what=what, layout=tare.layout)
        level = steady_level(raw)
        _check_steady(raw, level, press, tare)
        _check_others(level, press, tare)
        at_stop = tare.select((raw >= min(limit, _stop_counts(raw, press, tare))).mean(axis=0))
        is_full = press.taxels & (at_stop > MAX_SATURATED_READINGS)
        used = press.taxels & ~is_full
        rows.append(([press.pressure_kpa], [press.sigma_kpa], *of_taxels(level), used, is_full))
    everywhere = np.ones(tare.layout.num_taxels, dtype=np.bool_)
    rows.append(([0.0], [0.0], *of_taxels(tare.level), everywhere, ~everywhere))
    return _Points(*map(np.array, zip(*rows, strict=True)))


def _stop_counts(raw: np.ndarray, press: TaxelPress, tare: TaxelTare) -> float:
    """The reading at which pressed taxels end, infinity if they do not."""
    is_noisy = press.taxels & (tare.select(tare.level.noise_counts) > 0.5)
    readings = tare.select(raw)[:, is_noisy]
    top = readings.max(initial=-np.inf)
    num_at_top = ((readings == top).mean(axis=0) > 0.5).sum()
    return float(top) if num_at_top >= MIN_AT_STOP else np.inf


def _check_others(level: Level, press: TaxelPress, tare: TaxelTare) -> None:
    response = np.abs(tare.select(level.mean_counts - tare.level.mean_counts))
    least = max(MIN_MOVE_COUNTS, MAX_OTHERS * float(np.median(response[press.taxels])))
    others = [
        part
        for part, pad in _slices(tare.layout).items()
        if not press.taxels[pad].any() and np.median(response[pad]) > least
    ]
    if others:
        raise InvalidInputError(
            f"press of {press.pressure_kpa:g} kPa: moved {', '.join(others)}, which it does not "
            "name; press only the named pads, since a weight is shared by all that it lies on, or "
            "name all that a known pressure reaches; if nothing touched them, record the rest take "
            "again, just before the presses"
        )


def _check_range(gain: np.ndarray, layout: TactileLayout, full_scale_counts: float) -> None:
    if not len(gain):
        return
    # Gains are in the same steps of readings as this full scale, which may be below the layout's.
    highest = min(full_scale_counts, layout.full_scale / reading_step(layout))
    full_scale_kpa = highest / float(np.median(gain))
    ratio = full_scale_kpa / layout.range_kpa
    if not 1 / MAX_RANGE_RATIO < ratio < MAX_RANGE_RATIO:
        times = f"{max(ratio, 1 / ratio):.3g} times too {'high' if ratio > 1 else 'low'}"
        raise InvalidInputError(
            f"gain: the presses make {full_scale_kpa:.3g} kPa of full scale, expected about "
            f"{layout.range_kpa:g} kPa: the pressures seem {times}; enter them in kPa (a psi is "
            "6.895 kPa), or weights in kg and areas in cm2"
        )


def _check_steady(raw: np.ndarray, level: Level, press: TaxelPress, tare: TaxelTare) -> None:
    half = len(raw) // 2
    creep = np.abs(np.median(raw[:half], axis=0) - np.median(raw[half:], axis=0))
    response = np.abs(level.mean_counts - tare.level.mean_counts)
    allowed = np.maximum(MAX_CREEP * response, MIN_MOVE_COUNTS)
    unsteady = (creep > allowed) | (level.clipped > MAX_CREEPING)
    share = float(tare.select(unsteady)[press.taxels].mean())
    if share > MAX_CREEPING:
        raise InvalidInputError(
            f"press of {press.pressure_kpa:g} kPa: {share:.0%} of its taxels changed while it "
            f"lay, expected at most {MAX_CREEPING:.0%}; use only the time in which the pressure "
            "holds (start_s and stop_s of the list of presses)"
        )


def _creep(press: TaxelPress, tare: TaxelTare) -> float:
    """Change of the response from the first half of a press to the second, as a share of it."""
    first, second = (
        tare.select(np.median(part, axis=0) - tare.level.mean_counts)
        for part in np.array_split(np.asarray(press.counts, dtype=np.float64), 2)
    )
    responding = press.taxels & (first > MIN_MOVE_COUNTS)
    return float(np.median(second[responding] / first[responding] - 1)) if responding.any() else 0.0


def _trend(points: _Points, gain: np.ndarray, good: np.ndarray) -> Float64[np.ndarray, " taxels"]:
    """Error of gains, as a share, by trends of all taxels, or the largest bend tolerated."""
    used = points.used[:-1] & good & (gain > 0)
    highest_kpa = np.where(used, points.pressure_kpa[:-1], 0.0).max(axis=0)
    lowest_kpa = np.where(used, points.pressure_kpa[:-1], np.inf).min(axis=0)
    has_one = highest_kpa <= MIN_PRESSURE_RATIO * lowest_kpa
    is_informative = used.any(axis=1)
    if not is_informative.any():
        return np.zeros(len(gain))
    P = points.pressure_kpa[:-1][is_informative, 0]
    response_kpa = (points.counts[:-1] - points.counts[-1]) / np.where(gain > 0, gain, 1.0)
    seen_kpa = np.array(
        [
            np.median(r[u])
            for r, u in zip(response_kpa[is_informative], used[is_informative], strict=True)
        ]
    )
    sigma_kpa = np.maximum(points.sigma_kpa[:-1][is_informative, 0], MIN_PRESSURE_SIGMA * P)
    time = np.flatnonzero(is_informative) / max(len(is_informative) - 1, 1)
    # What each does to gains: a bend by its RMS about the line, a drift by its half, an offset by
    # what it is of the highest pressure.
    trends = {
        "bends over pressure": (P * P / P.max(), 1 / np.sqrt(12)),
        "drifts from press to press": (P * time, 0.5),
        "zero drifts from press to press": (0.5 + 0.5 * time, 1 / P.max()),
    }
    found = {}
    for name, (trend, effect) in trends.items():
        line, own = P / sigma_kpa, trend / sigma_kpa
        # What a line through zero leaves of a trend; of two pressures in turn maybe nothing.
        own = own - line * (own @ line) / (line @ line)
        length = np.linalg.norm(own)
        sigmas = abs(own @ (seen_kpa / sigma_kpa)) / max(length, np.finfo(float).tiny)
        if length > MIN_TREND_SHARE * np.linalg.norm(trend / sigma_kpa) and (
            sigmas > MIN_TREND_SIGMAS
        ):
            # Pressures near each other hardly tell a trend from their own errors, and a large one
            # is not expected.
            chance = effect / length / MAX_NONLINEARITY
            found[name] = sigmas / length * effect / (1 + chance**2)
    worst = max(found, key=lambda name: found[name], default="")
    if found and found[worst] > MAX_RELATIVE_SIGMA:
        raise InvalidInputError(
            f"gain: the response of all taxels {worst}, which moves gains by {found[worst]:.0%}, "
            f"expected at most {MAX_RELATIVE_SIGMA:.0%}; the pressures probably do not belong to "
            "these takes, or the glove did not settle; check the list of presses, take the rest "
            "take just before them, and press less where the response bends"
        )
    seen = found.get(worst, 0.0)
    return np.where(has_one, max(MAX_NONLINEARITY / np.sqrt(3), seen), seen)


def _check_direction(points: _Points) -> None:
    response = (points.counts[:-1] - points.counts[-1])[points.used[:-1]]
    responding = np.abs(response) >= MIN_MOVE_COUNTS
    if points.saturated.any() and not responding.any():
        raise InvalidInputError(
            "gain: every pressed taxel is at full scale; press less, or lower the glove's gain"
        )
    if not responding.any():
        raise InvalidInputError(
            f"gain: no pressed taxel moved by {MIN_MOVE_COUNTS:g} counts or more; check that the "
            "presses are those of this glove and side, and that the glove is connected"
        )
    if (response[responding] < 0).mean() > 0.5:
        raise InvalidInputError(
            "gain: counts fall under pressure; the rest take and a pressed take are probably "
            "exchanged, or this glove counts downwards and needs a decoder that inverts it"
        )


def _silent_under_pressure(points: _Points) -> Bool[np.ndarray, " taxels"]:
    response, used = points.counts[:-1] - points.counts[-1], points.used[:-1]
    usual = [np.median(r[u]) if u.any() else 0.0 for r, u in zip(response, used, strict=True)]
    least = np.array(usual)[:, None]
    is_informative = used & (least >= MIN_MOVE_COUNTS)
    silent = is_informative & (np.abs(response) < SILENT_RATIO * least)
    return is_informative.any(axis=0) & (silent == is_informative).all(axis=0)


def _lines(points: _Points) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gain, its sigma, zero and excess (χ² a degree of freedom) of taxels' lines (York 1966)."""
    P, gain = points.pressure_kpa, np.zeros(points.counts.shape[1])
    # A weight or gauge that is used again errs alike: so many presses count as one.
    num_same = np.maximum((P == P.T).astype(np.int64) @ points.used, 1)
    for _ in range(ROUNDS):
        variance = points.sigma_counts**2 + num_same * (gain * points.sigma_kpa) ** 2
        weight = np.where(points.used, 1 / np.maximum(variance, 1e-12), 0.0)
        total = weight.sum(axis=0)
        mean_P, mean_c = ((weight * values).sum(axis=0) / total for values in (P, points.counts))
        spread = (weight * (P - mean_P) ** 2).sum(axis=0)
        slope = (weight * (P - mean_P) * (points.counts - mean_c)).sum(axis=0)
        gain = np.divide(slope, spread, out=np.zeros(len(spread)), where=spread > 0)
    zero = mean_c - gain * mean_P
    chi2 = (weight * (points.counts - zero - gain * P) ** 2).sum(axis=0)
    excess = chi2 / np.maximum(points.used.sum(axis=0) - 2, 1)
    sigma = np.sqrt(np.maximum(excess, 1.0) / np.maximum(spread, 1e-300))
    return gain, sigma, zero, excess


def _judge_lines(
    points: _Points, line: tuple[np.ndarray, np.ndarray, np.ndarray], state: np.ndarray
) -> UInt8[np.ndarray, " taxels"]:
    gain, sigma, excess = line
    good = state == OK
    P, num = points.pressure_kpa, points.used.sum(axis=0)
    mean, middle = ((points.used * values).sum(axis=0) / num for values in (points.counts, P))
    off = np.where(points.used, points.counts - mean - gain * (P - middle), 0.0)
    highest_kpa = np.where(points.used, P, 0.0).max(axis=0)
    bent = np.abs(off).max(axis=0) > MAX_NONLINEARITY * np.abs(gain) * highest_kpa
    bent &= (excess > MIN_NONLINEARITY_SIGMAS**2) & (num >= MIN_POINTS_FOR_LINE)
    state = state.copy()
    state[good & ((highest_kpa < MIN_RANGE_KPA) | (sigma > MAX_RELATIVE_SIGMA * gain))] = IMPRECISE
    state[good & bent] = NONLINEAR
    state[good & (gain <= 0)] = DEAD
    if good.any() and (state[good] == NONLINEAR).mean() > 0.5:
        raise InvalidInputError(
            f"gain: {int((state == NONLINEAR).sum())} taxels are off a straight line by more than "
            f"{MAX_NONLINEARITY:.0%}; the pressures probably do not belong to these takes, or "
            "they did not settle; check the list of presses"
        )
    return state
