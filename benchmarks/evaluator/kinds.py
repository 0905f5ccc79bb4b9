"""Which mistakes the stage `evaluator` rolls out: kinds, strengths and their policies by start."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

from dextouch.errors import InvalidInputError, UnknownNameError
from services.twin import mistakes
from services.twin.mistakes import DEVELOPMENT, HELD_OUT, KINDS, TRAINING, Mistake
from services.twin.scripted_actions import mistake_name

SETS: Final[Mapping[str, tuple[str, ...]]] = {
    "development": tuple(DEVELOPMENT),
    "held-out": tuple(HELD_OUT),
    "training": tuple(TRAINING),
}
NONE, CHOSEN = "none", "chosen"
# Chosen for mixed outcomes: of 493 rollouts with the development and held-out kinds in six tasks,
# 0.88, 0.76, 0.62 and 0.42 succeeded in the twin at these strengths.
STRENGTHS: Final = (0.15, 0.3, 0.5, 0.8)


@dataclass(frozen=True)
class KindsPlan:
    """Scripts with one mistake each; a policy is a kind with a strength.

    `name` is that of the set; with `every_strength` every policy acts from every start, otherwise
    each kind has one strength at a start, in turn.
    """

    name: str
    kinds: tuple[str, ...]
    strengths: tuple[float, ...] = STRENGTHS
    every_strength: bool = False

    def __post_init__(self) -> None:
        for kind in self.kinds:
            if kind not in KINDS:
                raise UnknownNameError("kind of mistake", kind, [*SETS, *KINDS])
        if not self.kinds or not self.strengths or len(set(self.strengths)) < len(self.strengths):
            raise InvalidInputError(
                f"evaluator: got {len(self.kinds)} kinds of mistakes with strengths "
                f"{self.strengths}, expected at least one of each, and no strength twice"
            )

    @classmethod
    def parse(
        cls, text: str, strengths: tuple[float, ...] = STRENGTHS, *, every_strength: bool = False
    ) -> "KindsPlan | None":
        """The plan of the name of a set, or of NAME,NAME…; None for "none".

        Raises:
            UnknownNameError: no such set or kind.
            InvalidInputError: no strengths, or one twice.
        """
        if text == NONE:
            return None
        name, kinds = (text, SETS[text]) if text in SETS else (CHOSEN, tuple(text.split(",")))
        return cls(name, tuple(dict.fromkeys(kinds)), strengths, every_strength)

    def policies(self, seed: int) -> tuple[str, ...]:
        """Names of the policies that act from a start.

        A kind has the same strength at a start, whichever other kinds are rolled out, so that kept
        results are found again.
        """
        turns = len(self.strengths)
        return tuple(
            mistake_name(Mistake(kind, strength))
            for kind in self.kinds
            for number, strength in enumerate(self.strengths)
            if self.every_strength or number == (seed + list(KINDS).index(kind)) % turns
        )


@cache
def mistakes_digest() -> str:
    """sha256 of the code of all mistakes; their rollouts are repeated where it changes."""
    return hashlib.sha256(Path(str(mistakes.__file__)).read_bytes()).hexdigest()
