"""Root cause of what the check of a take found: one sentence and one advice for the operator."""

from collections.abc import Collection, Mapping, Sequence
from typing import Final

from dextouch.schemas import MAX_CAUSE, HealthCause, TakeCause, TakeCheck, TakeProblem
from services.acquisition.health import CODES
from services.acquisition.health.causes import SIMULATED_ADVICE

# What the check of the take reports itself, by the code of the health finding behind it.
IN_THE_CHECK: Final[Mapping[str, tuple[str, ...]]] = {
    "silent": ("gap", "missing_stream"),
    "unplugged": ("gap", "missing_stream"),
    "gap": ("gap", "missing_stream"),
    "rate": ("rate", "missing_stream"),
    "loss": ("loss",),
    "taxels_dead": ("dead_taxels",),
    "taxels_stuck": ("stuck_taxels",),
    "taxels_saturated": ("saturated_taxels",),
}
SUSPENDED: Final = "Switch off the suspend mode of this computer and record the take again."
# Gravest first; other codes follow.
_ORDER: Final = ("missing_stream", "gap", "rate", "loss")
# Code of the health finding whose advice fits a problem of the check.
_ADVICE: Final = {
    "missing_stream": "silent",
    "dead_taxels": "taxels_dead",
    "stuck_taxels": "taxels_stuck",
    "saturated_taxels": "taxels_saturated",
}


def root_cause(
    problems: Sequence[TakeProblem],
    causes: Sequence[HealthCause],
    simulated: Collection[str] = (),
) -> TakeCause | None:
    """The cause of the gravest problem; None without problems.

    Args:
        problems: of the take.
        causes: that the station's health saw during the take, widest first.
        simulated: streams of simulated devices.
    """
    if not problems:
        return None
    worst = min(problems, key=_rank)
    for cause in causes:
        if worst.stream in cause.streams and _explains(cause, worst):
            return TakeCause(message=cause.message, advice=cause.advice)
    alike = {p.stream for p in problems if (p.code, p.level) == (worst.code, worst.level)}
    others = len(alike) - 1
    more = f" (and in {others} other {'stream' if others == 1 else 'streams'})" if others else ""
    advice = CODES[_ADVICE.get(worst.code, worst.code)].advice
    if worst.stream in simulated:
        advice = SIMULATED_ADVICE
    return TakeCause(message=worst.message + more, advice=advice)


def incomplete_cause(check: TakeCheck) -> str:
    """Why a take is incomplete, for its attributes; empty of a complete one."""
    if check.complete:
        return ""
    errors = "; ".join(p.message for p in check.problems if p.level == "ERROR")
    return (check.cause.message if check.cause else errors)[:MAX_CAUSE]


def _rank(problem: TakeProblem) -> tuple[bool, int]:
    known = problem.code in _ORDER
    return problem.level != "ERROR", _ORDER.index(problem.code) if known else len(_ORDER)


def _explains(cause: HealthCause, problem: TakeProblem) -> bool:
    return any(problem.code in IN_THE_CHECK.get(code, (code,)) for code in cause.findings)
