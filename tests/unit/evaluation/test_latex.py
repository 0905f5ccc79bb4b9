"""LaTeX tables, against a table written by hand."""

from services.evaluation.rendering import escape_latex
from services.evaluation.reporting.sections import latex_tables
from services.evaluation.scores import ClosedLoopReport, RolloutScore

# Three policies, four starts, two imagined worlds: rates 1, 0, .5 | .75, .25, .5 | .5, .5, .5.
MARKS = {
    "real": {"FTP-1": "1111", "a_b": "0000", "C": "1100"},
    "WM-Robot": {"FTP-1": "1110", "a_b": "1000", "C": "1100"},
    "WM-Mix": {"FTP-1": "1100", "a_b": "1100", "C": "1100"},
}


def report(worlds):
    scores = tuple(
        RolloutScore(world, policy, "stand_bottle", n, f"{n}", mark == "1", 0.5)
        for world, policies in worlds.items()
        for policy, marks in policies.items()
        for n, mark in enumerate(marks)
    )
    return ClosedLoopReport(scores, tuple(w for w in worlds if w != "real"), tuple(worlds["real"]))


def test_rates_by_hand():
    rates, agreement, end = latex_tables(report(MARKS)).split("\\end{tabular}\n")
    assert end == ""
    # Wilson's intervals: 4 of 4 is 0.51 … 1, 3 of 4 is 0.30 … 0.95, 2 of 4 is 0.15 … 0.85.
    assert rates.splitlines() == [
        r"\begin{tabular}{llc}",
        r"\toprule",
        r"Policy & World & stand bottle \\",
        r"\midrule",
        r"\multirow{3}{*}{FTP-1} & Real world & 1.000 {\scriptsize [0.51, 1.00]} \\",
        r" & WM-Robot & 0.750 {\scriptsize [0.30, 0.95]} \\",
        r" & WM-Mix & 0.500 {\scriptsize [0.15, 0.85]} \\",
        r"\midrule",
        r"\multirow{3}{*}{a\_b} & Real world & 0.000 {\scriptsize [0.00, 0.49]} \\",
        r" & WM-Robot & 0.250 {\scriptsize [0.05, 0.70]} \\",
        r" & WM-Mix & 0.500 {\scriptsize [0.15, 0.85]} \\",
        r"\midrule",
        r"\multirow{3}{*}{C} & Real world & 0.500 {\scriptsize [0.15, 0.85]} \\",
        r" & WM-Robot & 0.500 {\scriptsize [0.15, 0.85]} \\",
        r" & WM-Mix & 0.500 {\scriptsize [0.15, 0.85]} \\",
        r"\bottomrule",
    ]
    rows = agreement.splitlines()
    assert rows[5].startswith(r"\multirow{4}{*}{WM-Robot} & Pearson & 1.000 {\scriptsize [")
    # WM-Robot ranks the policies as the real world does.
    assert rows[6].startswith(r" & Kendall & 1.000 {\scriptsize [")
    # Equal rates in the imagined world: no correlation, and a tie that the paper's rule misses.
    assert rows[10] == r"\multirow{4}{*}{WM-Mix} & Pearson & -- \\"
    assert rows[11] == r" & Kendall & -- \\"
    # MMRV: a tie hides that the first is 1 above the second and the third 0.5: (1 + 0 + 0.5) / 3.
    assert rows[12].startswith(r" & MMRV, ties counted & 0.500")
    assert rows[13].startswith(r" & MMRV, paper's rule & 0.000")


def test_two_policies_have_no_correlation():
    two = {world: dict(list(marks.items())[:2]) for world, marks in MARKS.items()}
    rows = latex_tables(report(two)).split("\\end{tabular}\n")[1].splitlines()
    assert rows[5] == r"\multirow{4}{*}{WM-Robot} & Pearson & undefined (2 policies) \\"


def test_a_real_world_alone_has_one_table():
    assert latex_tables(report({"real": MARKS["real"]})).count("tabular") == 2


def test_special_characters_are_escaped():
    assert escape_latex("50% of a_b & {c} #1 $x ~y^2 \\z") == (
        r"50\% of a\_b \& \{c\} \#1 \$x \textasciitilde{}y\textasciicircum{}2 \textbackslash{}z"
    )
    assert escape_latex("<a|b>") == r"\textless{}a\textbar{}b\textgreater{}"
