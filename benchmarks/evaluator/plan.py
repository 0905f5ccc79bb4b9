"""What the stage `evaluator` rolls out: tasks, starts, mistakes, and policies by name."""

import hashlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

from dextouch.errors import InvalidInputError, UnknownNameError
from services.evaluation.policies.user_policies import PolicySource
from services.twin import mistakes
from services.twin.mistakes import DEVELOPMENT, HELD_OUT, KINDS, TRAINING, Mistake
from services.twin.stage import ELSEWHERE, HOLD, RETREAT, mistake_name, script_name

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

        Raises UnknownNameError for no such set or kind, and InvalidInputError for no strengths, or
        one twice.
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


# 5 1/3 s at 15 steps a second, in chunks as policies send them.
NUM_STEPS: Final = 80
# Still hands are rolled out for 63 chunks, 1008 steps, with images after every 9th.
STILL_CHUNKS: Final = 63
STILL_SHOWN_EVERY: Final = 9
FIRST_SEED: Final = 30_000
LEVELS_MM: Final = (0.0, 2.5, 5.0, 7.5, 10.0, 15.0, 20.0, 30.0)
# Policies that cannot succeed, but might fool a judge that relies on motion.
IDLE: Final = (HOLD, RETREAT, ELSEWHERE)


@dataclass(frozen=True)
class ClonedPolicy:
    """A checkpoint of a cloned policy, identified by its name and content."""

    name: str
    path: Path

    @classmethod
    def parse(cls, text: str) -> "ClonedPolicy":
        """A policy from NAME=PATH; raises InvalidInputError for other text, or no such file."""
        name, _, path = text.partition("=")
        if not name or not Path(path).is_file():
            raise InvalidInputError(f"--cloned: got {text!r}, expected NAME=PATH of a checkpoint")
        return cls(name, Path(path))

    @property
    def key(self) -> str:
        """Name in results, with a digest of the checkpoint."""
        return f"{self.name}@{hashlib.sha256(self.path.read_bytes()).hexdigest()[:8]}"


@dataclass(frozen=True)
class OutsidePolicy:
    """A custom policy, identified by its name and the content of its module's file."""

    source: PolicySource
    digest: str

    @classmethod
    def parse(cls, text: str) -> "OutsidePolicy":
        """A policy from [NAME=]MODULE:FACTORY.

        Raises InvalidInputError, NotFoundError or UnknownNameError if it does not load.
        """
        source = PolicySource.parse(text)
        source.load({})
        path = sys.modules[source.module].__file__
        content = source.module.encode() if path is None else Path(path).read_bytes()
        return cls(source, hashlib.sha256(content).hexdigest()[:8])

    @property
    def key(self) -> str:
        """Name in results, with a digest of the module's file."""
        return f"{self.source.name}@{self.digest}"


@dataclass(frozen=True)
class Trained:
    """The checkpoints of one training seed: world model (None: the package's), judge, baselines.

    `direct` is a judge without a world model, `untouched` a world model trained without touch.
    """

    world: Path | None
    probe: Path
    direct: Path | None = None
    untouched: Path | None = None


def trained_seeds(
    worlds: Sequence[Path | None],
    probes: Sequence[Path],
    directs: Sequence[Path] = (),
    untouched: Sequence[Path] = (),
) -> tuple[Trained, ...]:
    """One entry for each world, with the other networks at the same index or the only ones.

    Raises:
        InvalidInputError: several judges, but not one for each world; or no world or judge.
    """
    options = (("--probe", probes, 1), ("--direct", directs, 0), ("--without-touch", untouched, 0))
    for what, paths, least in options:
        if not worlds or not (least <= len(paths) <= 1 or len(paths) == len(worlds)):
            raise InvalidInputError(
                f"evaluator: got {len(paths)} {what} for {len(worlds)} --world, expected one for "
                "all or one for each, in the same order"
            )
    count = len(worlds)
    columns: list[Sequence[Any]] = [
        [*paths] * (count if len(paths) == 1 else 1) or [None] * count
        for paths in (probes, directs, untouched)
    ]
    return tuple(Trained(*row) for row in zip(worlds, *columns, strict=True))


@dataclass(frozen=True)
class StudyPlan:
    """Everything that defines one run of the stage.

    `trained` are the checkpoints of every training seed; `keep` is the folder of results and
    arrays; without `levels_mm` only mistakes are rolled out, those of `kinds`; the first
    `num_still_starts` starts of a task are also held still for 1000 steps.
    """

    keep: Path
    trained: tuple[Trained, ...]
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    levels_mm: tuple[float, ...] = LEVELS_MM
    kinds: KindsPlan | None = None
    cloned: tuple[ClonedPolicy, ...] = ()
    outside: tuple[OutsidePolicy, ...] = ()
    num_still_starts: int = 3

    def __post_init__(self) -> None:
        if not self.tasks or not self.seeds or not (self.levels_mm or self.kinds):
            raise InvalidInputError(
                f"evaluator: got {len(self.tasks)} tasks, {len(self.seeds)} starts and "
                f"{len(self.levels_mm)} levels, expected at least one of each, or kinds of "
                "mistakes in place of levels"
            )

    @property
    def scripts(self) -> tuple[str, ...]:
        """Names of the scripted policies, by increasing error."""
        return tuple(script_name(level_mm) for level_mm in self.levels_mm)

    @property
    def policies(self) -> tuple[str, ...]:
        """Names of all policies but those with mistakes, which differ from start to start."""
        if not self.levels_mm:
            return ()
        closed_loop: tuple[ClonedPolicy | OutsidePolicy, ...] = (*self.cloned, *self.outside)
        return (*self.scripts, *IDLE, *(policy.key for policy in closed_loop))
