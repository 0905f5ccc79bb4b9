"""Sections of the report page: tiles, bars and error rows; tables for papers."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from services.evaluation.agreement import FIGURES
from services.evaluation.rendering import UNDEFINED, escape_latex, figure, is_number, rendered
from services.evaluation.scores import REAL, ClosedLoopReport

# Key of the figure, its name on the page, its unit, and its bound, if any.
ERRORS: tuple[tuple[str, str, str, tuple[str, float] | None], ...] = (
    ("taxel_iou", "Contact agreement (IoU)", "", ("≥", 0.98)),
    ("taxel_mae_kpa", "Taxel error", "kPa", None),
    ("wrist_error_mm", "Wrist position error", "mm", ("≤", 1.0)),
    ("wrist_error_deg", "Wrist rotation error", "°", ("≤", 0.1)),
    ("fingertip_error_mm", "Fingertip error", "mm", None),
)
CLOCK_BOUND_MS = 1.0
# Image baselines that the model must beat; the camera motion is known to all but the copy.
IMAGE_RIVALS = ("psnr_copy", "psnr_warp", "psnr_hands_still")
_FAILURE_FIELDS = ("policy", "world", "error", "message", "traceback")
# Bars beside those of the world model and of a copy of the first image or touch.
_RIVALS: Final = {
    "warp": "first image, warped by the camera motion",
    "zero": "predict no touch",
    "hands_still": "model, only the head moves",
    "hold": "model, nothing moves",
    "other_take": "model, another scene's actions",
    "codec": "codec alone (limit)",
}
_OF_IMAGES: Final = ("warp", "hands_still", "hold", "other_take", "codec")
_OF_CONTACT: Final = ("hands_still", "hold", "other_take")
# Title, unit, direction, metric, what the copy repeats, and the other bars.
COMPARISONS: tuple[tuple[str, str, str, str, str, tuple[str, ...]], ...] = (
    ("Images, PSNR", "dB", "more is better", "psnr", "image", _OF_IMAGES),
    ("Touch, mean squared error", "kPa²", "less is better", "tactile_mse", "touch",
     ("zero", *_OF_CONTACT)),
    ("Contact, F1", "", "more is better", "contact_f1", "touch", _OF_CONTACT),
)  # fmt: skip
LATEX_FIGURES: Final = ("pearson", "kendall", "mmrv", "mmrv_paper")


@dataclass(frozen=True)
class Bar:
    """A named value; `share` relative to the longest bar, `main` for the highlighted one."""

    name: str
    value: float
    share: float
    main: bool = False


@dataclass(frozen=True)
class BarGroup:
    """Bars of one unit under a title."""

    title: str
    unit: str
    note: str
    bars: list[Bar]


@dataclass(frozen=True)
class ErrorRow:
    """One error with its bound; `holds` is None without a bound or a figure."""

    name: str
    value: Any
    unit: str
    bound: str
    holds: bool | None


@dataclass(frozen=True)
class Tile:
    """One headline figure."""

    name: str
    value: str
    note: str


@dataclass(frozen=True)
class FailureRow:
    """Failed rollouts of one policy in one world with the same error; shows the first message."""

    policy: str
    world: str
    error: str
    message: str
    traceback: str | None
    count: int = 1


def undecided_note(row: Mapping[str, Any], name: str) -> str:
    """What to write beside a policy's rate of this name; empty if all rollouts were decided."""
    undecided = row.get(f"{name}_undecided", 0)
    if not undecided:
        return ""
    note = f"{undecided} of {row[f'{name}_rollouts']} cannot tell"
    return note if row[f"{name}_comparable"] else f"{note}, not comparable"


def comparison_bars(figures: Mapping[str, Any]) -> list[BarGroup]:
    """World model compared with its baselines."""
    groups = []
    for title, unit, note, metric, copied, rivals in COMPARISONS:
        if not is_number(figures.get(metric)):
            continue
        names = {metric: "world model", f"{metric}_copy": f"copy the first {copied}"}
        names |= {f"{metric}_{rival}": _RIVALS[rival] for rival in rivals}
        known = [
            (name, float(figures[k])) for k, name in names.items() if is_number(figures.get(k))
        ]
        longest = max(value for _, value in known) or 1.0
        bars = [Bar(n, v, max(0.0, v / longest), main=i == 0) for i, (n, v) in enumerate(known)]
        groups.append(BarGroup(title, unit, note, bars))
    return groups


def error_rows(errors: Mapping[str, Any]) -> list[ErrorRow]:
    """Errors of the recording path against the twin's ground truth, with their bounds."""
    rows = []
    if clocks := clock_rows(errors):
        # The one without a figure, or the worst one; the page folds the others.
        worst = max(clocks, key=lambda row: row.value if is_number(row.value) else math.inf)
        name = f"{worst.name}, the worst of {len(clocks)}"
        rows.append(replace(worst, name=name))
    for key, name, unit, bound in ERRORS:
        if key not in errors:
            continue
        value, holds = errors[key], None
        if bound and is_number(value):
            holds = value >= bound[1] if bound[0] == "≥" else value <= bound[1]
        rows.append(ErrorRow(name, value, unit, f"{bound[0]} {bound[1]:g}" if bound else "", holds))
    return rows


def clock_rows(errors: Mapping[str, Any]) -> list[ErrorRow]:
    """Errors of the clock fits of all streams."""
    return [
        ErrorRow(
            f"Clock of {stream.replace('_', ' ')}, RMS",
            value,
            "ms",
            f"≤ {CLOCK_BOUND_MS:g}",
            value <= CLOCK_BOUND_MS if is_number(value) else None,
        )
        for stream, value in dict(errors.get("clock_rms_ms", {})).items()
    ]


def failure_rows(report: Mapping[str, Any]) -> list[FailureRow]:
    """Failed rollouts, counted by policy, world and error class."""
    rows: dict[tuple[str, ...], FailureRow] = {}
    for entry in report.get("failures", []):
        row = FailureRow(**{name: entry[name] for name in _FAILURE_FIELDS})
        key = (row.policy, row.world, row.error)
        rows[key] = replace(rows[key], count=rows[key].count + 1) if key in rows else row
    return list(rows.values())


def tiles(report: Mapping[str, Any]) -> list[Tile]:
    """Headline figures available in this report."""
    found = []
    stages, errors = report.get("stages", []), report.get("errors", {})
    model, agreement = report.get("world_model", {}), report.get("agreement", {})
    if stages:
        total = sum(float(s["seconds"]) for s in stages)
        found.append(Tile("from bytes to score", f"{figure(total)} s", f"{len(stages)} stages"))
    clocks = [v for v in dict(errors.get("clock_rms_ms", {})).values() if is_number(v)]
    if clocks:
        found.append(Tile("worst clock", f"{figure(max(clocks), 2)} ms", "RMS, delay removed"))
    if is_number(errors.get("taxel_iou")):
        note = "contact IoU with the ground truth"
        found.append(Tile("touch recorded", figure(errors["taxel_iou"]), note))
    rivals = [model[k] for k in IMAGE_RIVALS if is_number(model.get(k))]
    if is_number(model.get("psnr")) and rivals:
        gain = model["psnr"] - max(rivals)
        note = "PSNR over the best baseline"
        found.append(Tile("images predicted", f"{gain:+.1f} dB", note))
    if is_number(model.get("tactile_mse")):
        best = min(
            (model[k] for k in ("tactile_mse_zero", "tactile_mse_copy") if is_number(model.get(k))),
            default=0.0,
        )
        if best > 0:
            ratio = model["tactile_mse"] / best
            found.append(Tile("touch predicted", f"{ratio:.0%}", "of the best baseline's error"))
    if agreement:
        tasks = list(agreement.values())
        found.append(_agreement_tile("worlds agree", "pearson", "Pearson", tasks))
        if any(is_number(task.get("mean_absolute_error")) for task in tasks):
            what = "mean absolute error of success rates"
            found.append(_agreement_tile("rates differ by", "mean_absolute_error", what, tasks))
    return found


def _agreement_tile(name: str, key: str, what: str, tasks: Sequence[Mapping[str, Any]]) -> Tile:
    """Mean of a figure over tasks, with the range of their 95 % intervals."""
    defined = [task for task in tasks if is_number(task.get(key))]
    if not defined:
        reasons = {figure(task.get(key)) for task in tasks}
        return Tile(name, reasons.pop() if len(reasons) == 1 else UNDEFINED, f"{what}, no task")
    value = figure(sum(task[key] for task in defined) / len(defined))
    intervals = [task.get(f"{key}_interval") for task in defined]
    known = [one for one in intervals if isinstance(one, list)]
    interval = "no interval"
    if known:
        low, high = min(one[0] for one in known), max(one[1] for one in known)
        interval = (
            f"95 % {'interval' if len(tasks) == 1 else 'intervals within'} {low:.2f} to {high:.2f}"
        )
    return Tile(name, value, f"{what}, {len(defined)} of {len(tasks)} tasks; {interval}")


def latex_tables(report: ClosedLoopReport) -> str:
    """LaTeX tables of a study: success rates by policy and world, and agreement by world.

    Rates are followed by 95 % Wilson intervals, agreement by its own intervals. Undecided rollouts
    are in no rate; their number follows it. The tables have the form of `policy_evaluator` and
    `wm_real_corr` of the paper, and need the packages booktabs and multirow.
    """
    agreement = {world: report.agreement(world) for world in report.imagined_worlds}
    return rendered(
        "tables.tex.j2",
        report=report,
        rows={(row["task"], row["policy"]): row for row in report.policy_rows()},
        worlds={REAL: "Real world"} | {one: escape_latex(one) for one in report.imagined_worlds},
        agreement=agreement,
        figures={name: FIGURES[name].title for name in LATEX_FIGURES},
        undecided_note=undecided_note,
    )
