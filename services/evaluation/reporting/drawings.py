"""Charts and image strips of the report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from dextouch.hands.actions import unpack_action
from dextouch.tactile.layout import FINGERS, SIDES
from services.evaluation.reporting.charts import Line, Point, agreement_chart, line_chart
from services.evaluation.reporting.pictures import (
    ActionPicture,
    Moment,
    ReportPictures,
    moments,
)
from services.evaluation.reporting.sections import AgreementFigure, agreement_figures, is_number

# S2 of every finger is abduction; the other three joints are flexion.
_FLEXION_HINGES = [0, 2, 3]


@dataclass(frozen=True)
class NamedChart:
    """A chart with its title and legend."""

    title: str
    svg: Markup
    names: tuple[str, ...]


@dataclass(frozen=True)
class PolicyPanel:
    """Policies, agreement, comments and chart of one task."""

    task: str
    rows: list[Mapping[str, Any]]
    agreement: list[AgreementFigure]
    comments: list[str]
    chart: Markup | None


@dataclass(frozen=True)
class Strip:
    """Images in rows over time: an episode, or ground truth above prediction."""

    title: str
    kind: str
    rows: list[tuple[str, list[Moment]]]


def clock_chart(pictures: ReportPictures) -> NamedChart | None:
    """Residuals of every fitted clock over time."""
    residuals = pictures.clock_residuals_ms
    if not residuals:
        return None
    lines = [
        Line(name, residual[0], residual[1], style=index)
        for index, (name, residual) in enumerate(residuals.items())
    ]
    svg = line_chart(lines, x_label="time (s)", y_label="residual (ms)")
    return NamedChart("Clock residuals after the fit", svg, tuple(residuals))


def action_charts(actions: ActionPicture | None) -> list[NamedChart]:
    """Wrist translation and finger flexion of both hands, measured and commanded."""
    if actions is None:
        return []
    kinds = {"reached": actions.measured}
    if actions.commanded is not None:
        kinds["commanded"] = actions.commanded
    charts = []
    for side in SIDES:
        wrist: list[Line] = []
        fingers: list[Line] = []
        for kind, rows in kinds.items():
            dashed = kind == "commanded"
            translation_cm = 100 * _wrist_m(rows, side)
            flexion_deg = np.degrees(_flexion_rad(rows, side))
            wrist += _lines(("x", "y", "z"), actions.times_s, translation_cm, dashed=dashed)
            fingers += _lines(FINGERS, actions.times_s, flexion_deg, dashed=dashed)
        svg = line_chart(wrist, x_label="time (s)", y_label="from its start (cm)")
        charts.append(NamedChart(f"{side.capitalize()} wrist", svg, ("x", "y", "z")))
        svg = line_chart(fingers, x_label="time (s)", y_label="mean flexion (°)")
        charts.append(NamedChart(f"{side.capitalize()} fingers", svg, FINGERS))
    return charts


def _lines(
    names: Sequence[str], times_s: np.ndarray, columns: np.ndarray, *, dashed: bool
) -> list[Line]:
    kind = "commanded" if dashed else "reached"
    return [
        Line(f"{name}, {kind}", times_s, columns[:, k], style=k, dashed=dashed)
        for k, name in enumerate(names)
    ]


def _wrist_m(actions: np.ndarray, side: str) -> np.ndarray:
    parts = unpack_action(actions)
    return (parts.wrist_left if side == "left" else parts.wrist_right)[:, :3]


def _flexion_rad(actions: np.ndarray, side: str) -> np.ndarray:
    parts = unpack_action(actions)
    joints = parts.joints_left_rad if side == "left" else parts.joints_right_rad
    return np.asarray(joints.reshape(-1, 5, 4)[:, :, _FLEXION_HINGES].mean(axis=2))


def policy_panels(report: Mapping[str, Any]) -> list[PolicyPanel]:
    """Scores of the policies and agreement of the worlds, one panel per task."""
    entries = report.get("policies", [])
    agreement, comments = report.get("agreement", {}), report.get("comments", {})
    panels = []
    for task in dict.fromkeys(str(e["task"]) for e in entries):
        rows = [e for e in entries if e["task"] == task]
        points = [
            Point(
                str(entry["policy"]),
                float(entry["real"]),
                float(entry["imagined"]),
                _interval(entry, "real"),
                _interval(entry, "imagined"),
                style=index,
            )
            for index, entry in enumerate(rows)
            if is_number(entry.get("real"))
            and is_number(entry.get("imagined"))
            and entry.get("imagined_comparable", True)
        ]
        chart = agreement_chart(points) if points else None
        figures = agreement_figures(agreement.get(task, {}))
        panels.append(PolicyPanel(task, rows, figures, comments.get(task, []), chart))
    return panels


def _interval(entry: Mapping[str, Any], world: str) -> tuple[float, float]:
    """Interval of a score, or the score itself if the report has none."""
    low, high = entry.get(f"{world}_interval") or (entry[world], entry[world])
    return float(low), float(high)


def strips(pictures: ReportPictures) -> list[Strip]:
    """Episodes as one row of images, predictions below their ground truth."""
    found = [
        Strip(e.title, "episode", [("", moments(e.times_s, e.images, e.tactile_kpa))])
        for e in pictures.episodes
    ]
    for p in pictures.predictions:
        true = moments(p.times_s, p.true_images, p.true_tactile_kpa)
        predicted = moments(p.times_s, p.predicted_images, p.predicted_tactile_kpa)
        found.append(Strip(p.title, "prediction", [("true", true), ("predicted", predicted)]))
    return found
