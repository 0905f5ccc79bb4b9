"""The evaluator's table as a self-contained HTML page."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from benchmarks.evaluator.drawn import Line

_STYLE = """body{font:15px/1.45 system-ui,sans-serif;max-width:72rem;
margin:2rem auto;padding:0 1rem}
table{border-collapse:collapse;width:100%;margin:0 0 2rem}caption{text-align:left;font-weight:600}
td,th{padding:.25rem .6rem;border-bottom:1px solid #ccc;text-align:right}
td:first-child,th:first-child{text-align:left}.met{color:#0a6b2b}.missed{color:#b00020}
@media(prefers-color-scheme:dark){body{background:#16181c;color:#e8e8e8}
.met{color:#6fd58c}.missed{color:#ff8a96}}"""


def write_page(
    path: Path,
    about: Mapping[str, str],
    lines: Sequence[Line],
    rows: Mapping[str, Sequence[Mapping[str, Any]]],
    notes: Sequence[str],
) -> None:
    """Write the digests, one table per task, and the tables of other rows by title."""
    tables = "".join(
        _table(task, [line for line in lines if line.task == task])
        for task in dict.fromkeys(line.task for line in lines)
    )
    digests = "".join(
        f"<li>{escape(name)}: <code>{escape(digest[:12])}</code></li>"
        for name, digest in about.items()
    )
    remarks = "".join(f"<li>{escape(note)}</li>" for note in notes)
    others = "".join(_plain_table(title, each) for title, each in rows.items() if each)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>Evaluator</title><style>{_STYLE}</style></head><body>"
        "<h1>How reliable is imagined success?</h1>"
        f"<ul>{digests}{remarks}</ul>{tables}{others}"
        "<p>Intervals are 95 % bootstrap intervals over the starts.</p></body></html>\n",
        encoding="utf-8",
    )


def _table(task: str, lines: Sequence[Line]) -> str:
    several = any(len(line.by_seed) > 1 for line in lines)
    words = ["", "figure", "interval", "bound", "verdict", *["training seeds"] * several]
    head = "".join(f"<th>{word}</th>" for word in words)
    rows = "".join(_row(line, several=several) for line in lines)
    return f"<table><caption>{escape(task)}</caption><tr>{head}</tr>{rows}</table>"


def _row(line: Line, *, several: bool) -> str:
    is_met = line.requirement().is_met
    word = {None: "not measured", True: "met", False: "missed"}[is_met]
    seeds = ", ".join(line.text(one) for one in line.by_seed)
    cells = (
        escape(line.what),
        f"{line.text(line.value)} {'' if line.value is None else escape(line.unit)}",
        "" if line.interval is None else f"{line.interval[0]:.3f} … {line.interval[1]:.3f}",
        f"{escape(line.sense)} {line.bound:g}",
        f'<span class="{word.split()[-1]}">{word}</span>',
        *([seeds] if several else []),
    )
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def _plain_table(title: str, rows: Sequence[Mapping[str, Any]]) -> str:
    columns = list(dict.fromkeys(name for row in rows for name in row))
    head = "".join(f"<th>{escape(name.replace('_', ' '))}</th>" for name in columns)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell(row.get(n)))}</td>" for n in columns) + "</tr>"
        for row in rows
    )
    return f"<table><caption>{escape(title)}</caption><tr>{head}</tr>{body}</table>"


def cell(value: object) -> str:
    """A value of a table as text."""
    return f"{value:.3f}" if isinstance(value, float) else "" if value is None else str(value)
