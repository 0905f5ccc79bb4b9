"""Plain sentences about scores: how many there are, which way a world errs, what is undefined."""

from collections.abc import Mapping, Sequence
from typing import Any

UNDEFINED = "undefined"
# Mean differences of success below this are not worth a word.
NOTABLE_BIAS = 0.05


def task_comments(
    rows: Sequence[Mapping[str, Any]], agreement: Mapping[str, Any], world: str
) -> list[str]:
    """Sentences about one task.

    Args:
        rows: of the task's policies, as `ClosedLoopReport.policy_rows` has them.
        agreement: of the task, as `ClosedLoopReport.agreement` has it.
        world: name of the imagined world.
    """
    num_starts = agreement["num_starts"]
    if num_starts == 0:
        return [f"No rollout ended both in the real world and in {world}: nothing to compare."]
    rows = [row for row in rows if UNDEFINED not in {row["real"], row["imagined"]}]
    size = (
        f"{agreement['num_policies']} policies, N = {num_starts} starts each: a single rollout "
        f"moves a success rate by {1 / num_starts:.2f}."
    )
    undefined = [_why_undefined(rows, world)] if agreement["pearson"] == UNDEFINED else []
    return [size, _mean_error(agreement["bias"], world), *_widest_gaps(rows, world), *undefined]


def _mean_error(bias: float, world: str) -> str:
    if bias >= NOTABLE_BIAS:
        return f"{world} flatters: its success rates are {bias:.2f} above the real ones on average."
    if bias <= -NOTABLE_BIAS:
        return (
            f"{world} is too strict: its success rates are {-bias:.2f} below the real ones "
            "on average."
        )
    return f"On average the success rates of {world} are {bias:+.2f} from the real ones."


def _widest_gaps(rows: Sequence[Mapping[str, Any]], world: str) -> list[str]:
    """For each direction the policy farthest off, among those whose 95 % intervals are apart."""
    sentences = []
    for verb, sign in (("overrates", 1), ("underrates", -1)):
        low, high = ("real", "imagined") if sign > 0 else ("imagined", "real")
        apart = [r for r in rows if r[f"{low}_interval"][1] < r[f"{high}_interval"][0]]
        if apart:
            row = max(apart, key=lambda r: abs(r["imagined"] - r["real"]))
            sentences.append(
                f"{world} {verb} {len(apart)} of {len(rows)} policies beyond chance (95 % "
                f"intervals apart); farthest off is {row['policy']!r}: {row['real']:.2f} real, "
                f"{row['imagined']:.2f} imagined."
            )
    return sentences


def _why_undefined(rows: Sequence[Mapping[str, Any]], world: str) -> str:
    if len(rows) < 2:
        return "Pearson is undefined: it takes at least two policies."
    for name, place in (("real", "in the real world"), ("imagined", f"in {world}")):
        if len({row[name] for row in rows}) == 1:
            return (
                f"Pearson is undefined: every policy has the same success rate "
                f"({rows[0][name]:.2f}) {place}, so there is nothing to correlate."
            )
    return "Pearson is undefined for these scores."
