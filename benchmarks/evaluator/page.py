"""Tables of the evaluator as a self-contained HTML page."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from benchmarks.report import ResultTable

_STYLE = """body{font:15px/1.45 system-ui,sans-serif;max-width:72rem;
margin:2rem auto;padding:0 1rem}
table{border-collapse:collapse;width:100%;margin:0 0 2rem}caption{text-align:left;font-weight:600}
td,th{padding:.25rem .6rem;border-bottom:1px solid #ccc;text-align:right}
td:first-child,th:first-child{text-align:left}.pass{color:#0a6b2b}.FAIL{color:#b00020}
@media(prefers-color-scheme:dark){body{background:#16181c;color:#e8e8e8}
.pass{color:#6fd58c}.FAIL{color:#ff8a96}}"""


def write_page(
    path: Path, about: Mapping[str, str], tables: Sequence[ResultTable], notes: Sequence[str]
) -> None:
    """Write the digests, the notes and the tables."""
    digests = "".join(
        f"<li>{escape(name)}: <code>{escape(digest[:12])}</code></li>"
        for name, digest in about.items()
    )
    remarks = "".join(f"<li>{escape(note)}</li>" for note in notes)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>Evaluator</title><style>{_STYLE}</style></head><body>"
        "<h1>How reliable is imagined success?</h1>"
        f"<ul>{digests}{remarks}</ul>{''.join(map(_table, tables))}"
        "<p>Intervals are 95 % bootstrap intervals over the starts.</p></body></html>\n",
        encoding="utf-8",
    )


def _table(table: ResultTable) -> str:
    head = "".join(f"<th>{escape(name.replace('_', ' '))}</th>" for name in table.columns)
    body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in table.rows)
    return f"<table><caption>{escape(table.title)}</caption><tr>{head}</tr>{body}</table>"


def _cell(text: str) -> str:
    kind = f' class="{text}"' if text in {"pass", "FAIL"} else ""
    return f"<td{kind}>{escape(text)}</td>"
