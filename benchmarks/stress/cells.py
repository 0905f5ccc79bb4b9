"""Cells of the stress matrix: checks of one stage under one numerical hazard.

A stage is a module with a `STAGE`; each hazard of `HAZARDS` is there either a function that checks
or a reason why the hazard cannot occur. The command and the tests run the same functions.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np

from dextouch.errors import DexTouchError, InvalidInputError, UnknownNameError

HAZARDS: Final[Mapping[str, str]] = {
    "rotations": "near-singular rotations: angles of 0 and π, parallel columns, lost quaternions",
    "one_axis": "motion about one axis only, or none",
    "clock": "clock steps, wraps, pauses and decreasing timestamps",
    "non_finite": "NaN, infinity, denormal and huge numbers",
    "touch": "zero and saturated touch",
    "ends": "t = 0 and t = 1: ends of intervals, flow time, rates of 0 and 1",
    "precision": "bfloat16 and float16 numbers",
    "device": "weights or inputs on another device",
    "long_run": "1000 steps: drift over 63 chunks of 16",
    "batch": "a batch of 1 compared with a batch of N",
}

Verdict = Literal["held", "failed", "does not apply", "not run"]


def bfloat16(values: np.ndarray) -> np.ndarray:
    """Values truncated to bfloat16's eight bits of mantissa, as float32."""
    bits = values.astype(np.float32).view(np.uint32) & np.uint32(0xFFFF0000)
    return bits.view(np.float32)


class Check:
    """Collects the statements of one cell; any false one fails it."""

    def __init__(self) -> None:
        self._told: list[str] = []
        self._broken: list[str] = []
        self._refusals: dict[str, list[str]] = {}
        self._bounds: dict[str, tuple[float, str]] = {}
        self.figures: dict[str, float] = {}

    @property
    def held(self) -> bool:
        """Whether at least one statement was checked and all are true."""
        has_checked = self._told or self._refusals or self._bounds
        within = all(self.figures[what] <= bound for what, (bound, _) in self._bounds.items())
        return bool(has_checked) and within and not self._broken

    @property
    def came_out(self) -> str:
        """Summary of the results, failures first."""
        figures: dict[bool, list[str]] = {True: [], False: []}
        for what, (bound, unit) in self._bounds.items():
            text = f"{what} {self.figures[what]:.3g} {unit}".rstrip() + f" (≤ {bound:g})"
            figures[self.figures[what] <= bound].append(text)
        refusals = [f"{kind}: {', '.join(what)}" for kind, what in self._refusals.items()]
        broken = [f"NOT {text}" for text in (*self._broken, *figures[False])]
        return "; ".join([*broken, *figures[True], *self._told, *refusals])

    def true(self, text: str, holds: object) -> None:
        """A statement that must be true."""
        found = self._told if bool(holds) else self._broken
        if text not in found:
            found.append(text)

    def at_most(
        self, what: str, value: float | int | np.number[Any], bound: float | int, unit: str = ""
    ) -> None:
        """A figure that must be finite and within its bound; the maximum of several is reported."""
        figure = float(value)
        if what not in self.figures or not figure <= self.figures[what]:
            self.figures[what] = figure
        self._bounds[what] = (bound, unit)

    def finite(self, what: str, values: np.ndarray) -> None:
        """Numbers that must all be finite."""
        self.true(f"{what} finite", np.isfinite(np.asarray(values, dtype=np.float64)).all())

    def equal(self, what: str, got: np.ndarray, expected: np.ndarray) -> None:
        """Arrays that must be bit-identical; NaN equals NaN."""
        a, b = np.asarray(got), np.asarray(expected)
        same = a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes()
        self.true(f"{what} equal to the bit", same)

    def refused(
        self,
        what: str,
        call: Callable[..., object],
        *arguments: object,
        kind: type[DexTouchError] = InvalidInputError,
        **options: object,
    ) -> None:
        """A call with these arguments that must raise a DexTouch error of this kind."""
        try:
            call(*arguments, **options)
        except kind as error:
            self._refusals.setdefault(type(error).__name__, []).append(what)
        except DexTouchError as error:
            self._broken.append(
                f"{what}: {type(error).__name__}, expected {kind.__name__} ({error.message})"
            )
        else:
            self._broken.append(f"{what}: accepted, expected {kind.__name__}")


@dataclass(frozen=True)
class Cell:
    """A check: description of its input, whether it is slow, and its function."""

    stage: str
    hazard: str
    fed: str
    slow: bool
    run: Callable[[Check], None]


@dataclass(frozen=True)
class Exemption:
    """A cell that does not apply, with the reason."""

    stage: str
    hazard: str
    reason: str


@dataclass
class StageCells:
    """The row of one stage: a cell or an exemption for every hazard."""

    name: str
    cells: dict[str, Cell | Exemption] = field(default_factory=dict)

    def cell(
        self, hazard: str, fed: str, *, slow: bool = False
    ) -> Callable[[Callable[[Check], None]], Callable[[Check], None]]:
        """Decorator that registers a function as the check of a hazard."""
        self._free(hazard)

        def add(run: Callable[[Check], None]) -> Callable[[Check], None]:
            self.cells[hazard] = Cell(self.name, hazard, fed, slow, run)
            return run

        return add

    def does_not_apply(self, **reasons: str) -> None:
        """Declare hazards that cannot occur in the stage, with reasons."""
        for hazard, reason in reasons.items():
            self._free(hazard)
            self.cells[hazard] = Exemption(self.name, hazard, reason)

    def row(self) -> list[Cell | Exemption]:
        """Every hazard in the order of the matrix.

        Raises UnknownNameError if a hazard of the matrix has neither a check nor a reason.
        """
        missing = [hazard for hazard in HAZARDS if hazard not in self.cells]
        if missing:
            raise UnknownNameError(f"cell of stage {self.name}", missing[0], list(self.cells))
        return [self.cells[hazard] for hazard in HAZARDS]

    def _free(self, hazard: str) -> None:
        if hazard not in HAZARDS:
            raise UnknownNameError("hazard", hazard, list(HAZARDS))
        if hazard in self.cells:
            raise InvalidInputError(f"stress: {self.name}, {hazard} is registered twice")


@dataclass(frozen=True)
class Finding:
    """Result of one cell."""

    stage: str
    hazard: str
    fed: str
    came_out: str
    verdict: Verdict
    figures: dict[str, float]
    time_s: float


def run_cell(cell: Cell | Exemption) -> Finding:
    """Run one cell; any unexpected exception fails it."""
    if isinstance(cell, Exemption):
        return Finding(cell.stage, cell.hazard, "", cell.reason, "does not apply", {}, 0.0)
    check = Check()
    begin_s = time.perf_counter()
    try:
        cell.run(check)
    except Exception as error:  # noqa: BLE001 - an unexpected error is the finding
        text = " ".join(str(error).split())
        check.true(f"expected: {type(error).__name__}: {text[:200]}", holds=False)
    verdict: Verdict = "held" if check.held else "failed"
    elapsed_s = time.perf_counter() - begin_s
    outcome = check.came_out or "nothing was checked"
    return Finding(cell.stage, cell.hazard, cell.fed, outcome, verdict, check.figures, elapsed_s)


def not_run(cell: Cell) -> Finding:
    """Result of a slow cell that a quick run skips."""
    text = "slow; run without --quick"
    return Finding(cell.stage, cell.hazard, cell.fed, text, "not run", {}, 0.0)
