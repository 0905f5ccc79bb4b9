"""LaTeX tables of a study: success rates by policy and world, and agreement by world.

They have the form of tables `policy_evaluator` and `wm_real_corr` of the paper, and need the
packages booktabs and multirow.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from services.evaluation.comments import UNDEFINED
from services.evaluation.reporting.sections import figure, is_number, undecided_note
from services.evaluation.scores import REAL, ClosedLoopReport

_ESCAPED: Final = {letter: rf"\{letter}" for letter in "#$%&_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
}
_FIGURES: Final = (("pearson", "Pearson"), ("mmrv", "MMRV"), ("mmrv_paper", "MMRV (paper)"))


def latex_tables(report: ClosedLoopReport) -> str:
    """Both tables; rates are followed by 95 % Wilson intervals, agreement by its own intervals.

    Undecided rollouts are in no rate; their number follows it.
    """
    rows = {(row["task"], row["policy"]): row for row in report.policy_rows()}
    worlds = (REAL, *report.imagined_worlds)
    lines = _head(report.tasks, "Policy", "World")
    for policy in report.policies:
        for index, world in enumerate(worlds):
            label = rf"\multirow{{{len(worlds)}}}{{*}}{{{escape(policy)}}}" if index == 0 else ""
            cells = [_rate(rows[task, policy], world, report) for task in report.tasks]
            name = "Real world" if world == REAL else escape(world)
            lines.append(_row(label, name, cells))
        lines.append(r"\midrule")
    lines[-1:] = [r"\bottomrule", r"\end{tabular}", ""]
    if not report.imagined_worlds:
        return "\n".join(lines)
    lines += _head(report.tasks, "World", "Figure")
    for world in report.imagined_worlds:
        agreement = report.agreement(world)
        for index, (key, name) in enumerate(_FIGURES):
            label = rf"\multirow{{{len(_FIGURES)}}}{{*}}{{{escape(world)}}}" if index == 0 else ""
            cells = [
                _with_interval(agreement[task].get(key), agreement[task].get(f"{key}_interval"))
                for task in report.tasks
            ]
            lines.append(_row(label, name, cells))
        lines.append(r"\midrule")
    lines[-1:] = [r"\bottomrule", r"\end{tabular}", ""]
    return "\n".join(lines)


def escape(text: str) -> str:
    """Text with LaTeX's special characters escaped."""
    return "".join(_ESCAPED.get(letter, letter) for letter in text)


def _head(tasks: Sequence[str], first: str, second: str) -> list[str]:
    return [
        rf"\begin{{tabular}}{{ll{'c' * len(tasks)}}}",
        r"\toprule",
        _row(first, second, [escape(task.replace("_", " ")) for task in tasks]),
        r"\midrule",
    ]


def _row(first: str, second: str, cells: Sequence[str]) -> str:
    return " & ".join([first, second, *cells]) + r" \\"


def _rate(row: Mapping[str, Any], world: str, report: ClosedLoopReport) -> str:
    if world == REAL:
        return _with_interval(row[REAL], row.get("real_interval"))
    is_first = world == report.imagined_worlds[0]
    name, cell = ("imagined", row) if is_first else ("success", row["other_worlds"][world])
    rate, undecided = (
        _with_interval(cell[name], cell.get(f"{name}_interval")),
        undecided_note(cell, name),
    )
    return rf"{rate} {{\scriptsize {escape(undecided)}}}" if undecided else rate


def _with_interval(value: object, interval: object) -> str:
    if not is_number(value):
        return "--" if figure(value) == UNDEFINED else figure(value)
    if not isinstance(interval, list):
        return f"{value:.3f}"
    return rf"{value:.3f} {{\scriptsize [{interval[0]:.2f}, {interval[1]:.2f}]}}"
