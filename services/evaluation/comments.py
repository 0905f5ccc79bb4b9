"""Plain sentences about scores: sample size, bias of a world, undefined figures."""

from collections.abc import Mapping, Sequence
from typing import Any

from dextouch.metrics.policy import MIN_POLICIES
from services.evaluation.calibration import LEAST_DECIDED

UNDEFINED = "undefined"
# Smaller mean differences of success are not mentioned.
NOTABLE_BIAS = 0.05
# Changes of a correlation by one policy below this are not mentioned.
NOTABLE_INFLUENCE = 0.1
# A correlation that may be below this is not shown to be good.
VAGUE_R = 0.5


def undefined_by(num_policies: int) -> str:
    """Text of an undefined figure; it names the number of policies if they are too few."""
    if 0 < num_policies < MIN_POLICIES:
        return f"{UNDEFINED} ({num_policies} {'policy' if num_policies == 1 else 'policies'})"
    return UNDEFINED


def task_comments(
    rows: Sequence[Mapping[str, Any]], agreement: Mapping[str, Any], world: str
) -> list[str]:
    """Sentences about one task.

    Args:
        rows: rows of the task's policies, from `ClosedLoopReport.policy_rows`.
        agreement: figures of the task, from `ClosedLoopReport.agreement`.
        world: name of the imagined world.
    """
    both = f"both worlds (real and {world})"
    undecided = _undecided(rows, agreement["not_comparable"], world)
    if agreement["num_starts"] == 0:
        if len(agreement["not_comparable"]) == len(rows):
            return [*undecided, "No policy is left to compare."]
        nothing = f"No start was completed in {both} by every policy: nothing to compare."
        return [*undecided, nothing]
    undefined = []
    if isinstance(agreement["pearson"], str):
        undefined = [_why_undefined(list(agreement["rates"].values()), world)]
    return [
        *undecided,
        _compared_starts(rows, agreement, both),
        _size_of_a_step(rows),
        _mean_error(agreement["bias"], world),
        *_widest_gaps(rows, world),
        *undefined,
        *_correlation(agreement),
    ]


def _correlation(agreement: Mapping[str, Any]) -> list[str]:
    """Interval and chance level of the correlation, and the policy that influences it most."""
    interval, chance = agreement.get("pearson_interval"), agreement.get("pearson_chance")
    if not isinstance(interval, list) or not isinstance(chance, float):
        return []
    low, high = interval
    vague = "; too wide to tell a faithful world from a poor one" if low < VAGUE_R else ""
    sentences = [
        f"Between the policies' true success rates Pearson's r is {low:.2f} to {high:.2f} (95 %)"
        f"{vague}. {_chance(chance)}"
    ]
    r, without = agreement["pearson"], agreement["pearson_without"]
    moved = {name: value - r for name, value in without.items() if not isinstance(value, str)}
    name = max(moved, key=lambda one: abs(moved[one]), default=None)
    if name is not None and abs(moved[name]) >= NOTABLE_INFLUENCE:
        sentences.append(f"Without {name!r}, r would be {without[name]:.2f} instead of {r:.2f}.")
    return sentences


def _chance(chance: float) -> str:
    share = f"{chance:.2g}" if chance >= 0.001 else "fewer than one in a thousand"
    return f"Share of all pairings of the policies' rates that correlate at least as well: {share}."


def _undecided(
    rows: Sequence[Mapping[str, Any]], not_comparable: Sequence[str], world: str
) -> list[str]:
    """How many rollouts are in no rate, and which policies are not compared because of that."""
    undecided = sum(row.get("imagined_undecided", 0) for row in rows)
    if not undecided:
        return []
    sentences = [
        f"Of {undecided} of {sum(row['imagined_rollouts'] for row in rows)} rollouts in {world} it "
        "cannot be told whether they succeeded; they count in no rate."
    ]
    if not_comparable:
        sentences.append(
            f"Not compared, because fewer than {LEAST_DECIDED:.0%} of the rollouts in {world} were "
            f"decided: {', '.join(map(repr, not_comparable))}."
        )
    return sentences


def _compared_starts(
    rows: Sequence[Mapping[str, Any]], agreement: Mapping[str, Any], both: str
) -> str:
    named = {*agreement["rates"], *agreement["not_comparable"]}
    left_out = [repr(row["policy"]) for row in rows if row["policy"] not in named]
    unless = f" except {', '.join(left_out)}, which completed none" if left_out else ""
    num_starts = rows[0]["real_rollouts"] + rows[0]["real_failed"]
    return (
        f"Agreement is computed over {agreement['num_starts']} of {num_starts} starts, those "
        f"completed in {both} by every policy{unless}."
    )


def _size_of_a_step(rows: Sequence[Mapping[str, Any]]) -> str:
    """Contribution of one rollout to a rate, by the number of completed real rollouts."""
    policies: dict[int, list[str]] = {}
    for row in rows:
        if row["real_rollouts"]:
            policies.setdefault(row["real_rollouts"], []).append(repr(row["policy"]))
    steps = [f"{1 / n:.2f} (N = {n}: {', '.join(names)})" for n, names in policies.items()]
    if len(steps) == 1:
        n = next(iter(policies))
        steps = [f"{1 / n:.2f} (N = {n} for each policy)"]
    return f"One rollout changes a real success rate by {' or '.join(steps)}."


def _mean_error(bias: float, world: str) -> str:
    start = "On these starts"
    if bias >= NOTABLE_BIAS:
        return (
            f"{start} {world} is too optimistic: its success rates are {bias:.2f} above the "
            "real ones on average."
        )
    if bias <= -NOTABLE_BIAS:
        return (
            f"{start} {world} is too pessimistic: its success rates are {-bias:.2f} below "
            "the real ones on average."
        )
    return f"{start} the success rates of {world} are {bias:+.2f} from the real ones on average."


def _widest_gaps(rows: Sequence[Mapping[str, Any]], world: str) -> list[str]:
    """The policy with the largest gap in each direction, if its 95 % intervals do not overlap.

    The rates are those of the report, over all completed rollouts of a policy.
    """
    rows = [
        row
        for row in rows
        if UNDEFINED not in {row["real"], row["imagined"]} and row["imagined_comparable"]
    ]
    sentences = []
    for verb, sign in (("overrates", 1), ("underrates", -1)):
        low, high = ("real", "imagined") if sign > 0 else ("imagined", "real")
        apart = [r for r in rows if r[f"{low}_interval"][1] < r[f"{high}_interval"][0]]
        if apart:
            row = max(apart, key=lambda r: abs(r["imagined"] - r["real"]))
            sentences.append(
                f"Over all completed rollouts, {world} {verb} {len(apart)} of {len(rows)} policies "
                "beyond chance (95 % intervals do not overlap), most of all "
                f"{row['policy']!r}: {row['real']:.2f} real, {row['imagined']:.2f} imagined."
            )
    return sentences


def _why_undefined(rates: Sequence[Mapping[str, float]], world: str) -> str:
    if len(rates) < MIN_POLICIES:
        return (
            f"Pearson is {undefined_by(len(rates))}: it needs at least three policies, since two "
            "points always lie on a line. The mean absolute error needs no more than one."
        )
    same_real = len({rate["real"] for rate in rates}) == 1
    side, place = ("real", "the real world") if same_real else ("imagined", world)
    return (
        "Pearson is undefined: on these starts every policy has the same success rate "
        f"({rates[0][side]:.2f}) in {place}, so there is nothing to correlate."
    )
