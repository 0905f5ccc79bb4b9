"""Module docstrings say what a module is, not what goes in and comes out of it."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# "A folder of photos in; their names and grey pixels out." "Bytes come in, samples go out."
FORMULA = re.compile(
    r"\bin(?: \([^)]*\))?[,;].*\bout\b|\bcomes? in\b.*\bgo(?:es)? out\b", re.DOTALL
)


def has_formula(source):
    """Whether the first paragraph of a module's docstring is of the form "…in, …out"."""
    docstring = ast.get_docstring(ast.parse(source)) or ""
    return bool(FORMULA.search(docstring.split("\n\n")[0]))


def test_the_formula_is_recognized():
    assert has_formula('"""Photos in; their names and\ngrey pixels out."""')
    assert has_formula('"""Settings in, the application out: ready to serve.\n\nMore."""')
    assert has_formula('"""Environment and flags in (DEXTOUCH_…), settings out."""')
    assert has_formula('"""Bytes come in from the reader; samples go out."""')
    assert not has_formula('"""Pages for signing in and out."""')
    assert not has_formula('"""Resampling of poses to a grid, with outliers removed."""')
    assert not has_formula('"""Clock models.\n\nSamples come in, times go out."""')


@pytest.mark.long
def test_module_sentences_say_what_a_module_is():
    folders = ("shared", "services", "benchmarks")
    modules = sorted(path for folder in folders for path in ROOT.glob(f"{folder}/**/*.py"))
    found = [
        str(path.relative_to(ROOT))
        for path in modules
        if has_formula(path.read_text(encoding="utf-8"))
    ]
    assert not found, f"say what these modules are, not what goes in and out: {found}"
