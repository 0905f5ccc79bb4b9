"""The files of a study: its definition in study.toml, and its results.

Results are an append-only file of one JSON line per rollout, so that a study can be resumed.
"""

import fcntl
import hashlib
import json
import os
import re
import time
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from dextouch.episodes import EpisodeStore, write_rollout
from dextouch.errors import ConflictError, CorruptDataError, InvalidInputError, StorageError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import (
    EpisodeAttributes,
    LineageEntry,
    Origin,
    StoredAnchor,
    WorldDescription,
    first_problems,
    matrix_rows,
)
from dextouch.tactile.layout import TactileLayout
from services.evaluation.bundled_policies import BUNDLED, BundledName, checkpoint_of
from services.evaluation.closed_loop import PlayedRollout
from services.evaluation.matched_starts import MatchedStart
from services.evaluation.scores import REAL, ClosedLoopReport, Outcome, RolloutFailure, RolloutScore

NAME_PATTERN: Final = r"^[A-Za-z0-9][A-Za-z0-9 ._+-]{0,63}$"
MAX_ROLLOUTS: Final = 100_000  # chosen: some hundred bytes of results each
# Starts are kept in memory, with one image per camera.
MAX_STARTS: Final = 2_000
Name = Annotated[str, Field(pattern=NAME_PATTERN)]


def _expect_one(choice: FrozenModel, *names: str) -> None:
    given = [name for name in names if getattr(choice, name)]
    if len(given) != 1:
        expected = f"{', '.join(names[:-1])} and {names[-1]}"
        raise ValueError(f"got {', '.join(given) or 'none'}, expected exactly one of {expected}")


class WorldChoice(FrozenModel):
    """A world: one served at a URL, or one that the study serves while it runs.

    Exactly one of `url` (with `world`, its name at the service), `checkpoint` (a world model's
    file) and `builtin` is given. The API key is read from the environment variable
    `api_key_variable`, so that no study file holds a secret. `probe` is the success classifier that
    was calibrated for this imagined world; by default the study's.
    """

    url: str | None = None
    world: str | None = None
    api_key_variable: str | None = None
    checkpoint: Path | None = None
    builtin: Literal["twin", "world-model"] | None = None
    probe: Path | None = None

    @model_validator(mode="after")
    def _is_one(self) -> "WorldChoice":
        _expect_one(self, "url", "checkpoint", "builtin")
        if (self.url is None) == (self.world is not None):
            raise ValueError("`world` names a world of the service at `url`; give both or neither")
        return self


class PolicyChoice(FrozenModel):
    """A policy, in exactly one of four ways.

    `factory` is MODULE:FACTORY with `arguments`; `builtin` a bundled policy; `replay` an episode
    store whose commanded actions are sent; `script` one of the twin's own demonstrators: `script 10
    mm` has object positions wrong by 10 mm, `retreat` and `another scene's actions` should fail.
    """

    factory: str | None = None
    arguments: dict[str, Any] = Field(default={})
    builtin: BundledName | None = None
    checkpoint: Path | None = None
    replay: str | None = None
    script: str | None = None

    @model_validator(mode="after")
    def _is_one(self) -> "PolicyChoice":
        _expect_one(self, "factory", "builtin", "replay", "script")
        if self.arguments and not self.factory:
            raise ValueError("`arguments` belong to `factory`")
        if self.checkpoint and (self.builtin is None or checkpoint_of(self.builtin) is None):
            having = [name for name in BUNDLED if checkpoint_of(name) is not None]
            raise ValueError(f"`checkpoint` belongs to builtin = {' or '.join(having)}")
        return self


class StudyDefinition(FrozenModel):
    """What a study compares.

    Every policy is rolled out from every start (task and seed) in the real world once and in every
    imagined world `repeats` times, `in_flight` rollouts of each world at a time.
    """

    name: Name
    tasks: tuple[str, ...] = Field(min_length=1, max_length=100)
    first_seed: int = Field(ge=0, lt=2**40)
    num_starts: int = Field(ge=1, le=10_000)
    num_steps: int = Field(default=80, ge=4, le=10_000)
    repeats: int = Field(default=1, ge=1, le=100)
    in_flight: int = Field(default=4, ge=1, le=64)
    keep_rollouts: bool = True
    probe: Path | None = None
    real: WorldChoice = WorldChoice(builtin="twin")
    imagined: dict[Name, WorldChoice] = Field(default={}, max_length=20)
    policies: dict[Name, PolicyChoice] = Field(min_length=1, max_length=100)

    @model_validator(mode="after")
    def _is_possible(self) -> "StudyDefinition":
        if len(set(self.tasks)) != len(self.tasks):
            raise ValueError(f"tasks: got {', '.join(self.tasks)}, expected no task twice")
        if REAL in self.imagined:
            raise ValueError(f"imagined: {REAL!r} names the real world; choose another name")
        if self.real.probe is not None:
            raise ValueError("real.probe: the success classifier of the real world is `probe`")
        if len(self.tasks) * self.num_starts > MAX_STARTS:
            raise ValueError(
                f"got {len(self.tasks) * self.num_starts} starts, expected at most {MAX_STARTS}"
            )
        if self.num_rollouts > MAX_ROLLOUTS:
            raise ValueError(f"got {self.num_rollouts} rollouts, expected at most {MAX_ROLLOUTS}")
        return self

    @property
    def seeds(self) -> range:
        """Seeds of the starts of every task."""
        return range(self.first_seed, self.first_seed + self.num_starts)

    @property
    def num_rollouts(self) -> int:
        """Number of rollouts in all worlds."""
        starts = len(self.tasks) * self.num_starts
        return starts * len(self.policies) * (1 + self.repeats * len(self.imagined))

    @property
    def digest(self) -> str:
        """SHA-256 of everything that can change a result, if only by rounding."""
        # Policies without images get their last chunk in two parts unless rollouts are kept.
        text = self.model_dump_json(exclude={"name"})
        return hashlib.sha256(text.encode()).hexdigest()


def read_definition(path: Path) -> StudyDefinition:
    """Read a study file.

    Raises InvalidInputError, with all problems, if it cannot be read or defines no study.
    """
    try:
        fields = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidInputError(f"study {path}: cannot be read ({error})") from error
    try:
        return StudyDefinition.model_validate(fields)
    except ValidationError as error:
        raise InvalidInputError(f"study {path}: {first_problems(error)}") from error


FILE: Final = "results.jsonl"
# Store of a study's rollouts in its folder.
KEPT_FOLDER: Final = "rollouts"
_MAX_LABEL: Final = 64
_LOCK_TRIES: Final = 10
_LOCK_PAUSE_S: Final = 0.05
_ORIGINS: Final[dict[str, Origin]] = {"twin": "twin", "robot": "recorded"}


class PlannedRollout(NamedTuple):
    """One rollout of a study."""

    world: str
    task: str
    seed: int
    policy: str
    repeat: int


@dataclass(frozen=True)
class StudyHeader:
    """First line of the file: what the results belong to.

    `definition` is that of the study as JSON; `digests` are those of the definition, of every world
    and of the success classifier. Results are only continued with equal digests.
    """

    name: str
    definition: dict[str, Any]
    digests: dict[str, str]


_ROW: Final = TypeAdapter[Outcome](Outcome)
_HEADER: Final = TypeAdapter(StudyHeader)


class StudyResults:
    """The results of one study, by rollout; open with `create_or_resume`."""

    def __init__(
        self, path: Path, header: StudyHeader, outcomes: dict[PlannedRollout, Outcome]
    ) -> None:
        self.path = path
        self.header = header
        self.outcomes = outcomes

    @cached_property
    def definition(self) -> StudyDefinition:
        """What the study compares; raises CorruptDataError if another version wrote it."""
        try:
            return StudyDefinition.model_validate(self.header.definition)
        except ValidationError as error:
            raise CorruptDataError(
                f"results {self.path}: the definition is not one of this version "
                f"({first_problems(error)}); use the version that wrote it"
            ) from error

    @classmethod
    def create_or_resume(cls, folder: Path, header: StudyHeader) -> "StudyResults":
        """Open the results of a study; an incomplete last line of a killed study is removed.

        Raises ConflictError if the folder holds results of another study, worlds or policies, or
        another process is running it, and as `read`.
        """
        path = folder / FILE
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if path.exists():
                # Whether another process is writing to it.
                with _locked(path):
                    pass
            if not path.exists() or b"\n" not in path.read_bytes():
                path.write_bytes(_line(asdict(header)))
                return cls(path, header, {})
            whole = path.read_bytes()
            kept = whole[: whole.rindex(b"\n") + 1]
            if len(kept) < len(whole):
                os.truncate(path, len(kept))
        except OSError as error:
            raise StorageError(f"results {path}: {error}; choose another --folder") from error
        found = cls.read(folder)
        old, new = found.header.digests, header.digests
        if changed := [name for name in {**old, **new} if old.get(name) != new.get(name)]:
            raise ConflictError(
                f"results {path}: belong to another study ({', '.join(changed)} changed); "
                "choose another --folder, or delete this one"
            )
        return found

    @classmethod
    def read(cls, folder: Path) -> "StudyResults":
        """Read the results in a folder; an incomplete last line is ignored.

        Raises StorageError if they cannot be read, and CorruptDataError for a damaged line.
        """
        path = folder / FILE
        try:
            first, *rows = path.read_bytes().split(b"\n")[:-1]
        except (OSError, ValueError) as error:
            raise StorageError(f"results {path}: no results of a study ({error})") from error
        outcomes: dict[PlannedRollout, Outcome] = {}
        number, line = 1, first
        try:
            header = _HEADER.validate_json(first)
            for number, line in enumerate(rows, 2):  # noqa: B007 - for the message
                outcome = _ROW.validate_json(line)
                outcomes[planned_rollout_of(outcome)] = outcome
        except ValidationError as error:
            raise CorruptDataError(
                f"results {path}, line {number}: not a row of a study ({line[:60]!r}); move the "
                "folder away and run the study again"
            ) from error
        return cls(path, header, outcomes)

    def locked(self) -> AbstractContextManager[None]:
        """Context in which no other process may add results; raises ConflictError."""
        return _locked(self.path)

    @staticmethod
    def is_running(folder: Path) -> bool:
        """Whether a process is adding results to a folder."""
        with (folder / FILE).open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
        return False

    def keep(self, outcome: Outcome) -> None:
        """Append an outcome; it is on the disk when this returns.

        Raises StorageError if the file cannot be written.
        """
        try:
            with self.path.open("ab") as file:
                file.write(_line(asdict(outcome)))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise StorageError(f"results {self.path}: cannot be written ({error})") from error
        self.outcomes[planned_rollout_of(outcome)] = outcome


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("rb") as file:
        # Those who only look (`StudyResults.is_running`) hold the lock for an instant.
        for tries_left in reversed(range(_LOCK_TRIES)):
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if not tries_left:
                    raise ConflictError(
                        f"results {path}: another process is running this study; wait for it, or "
                        "choose another --folder"
                    ) from error
                time.sleep(_LOCK_PAUSE_S)
        yield


def planned_rollout_of(outcome: Outcome) -> PlannedRollout:
    """The cell that an outcome belongs to."""
    return PlannedRollout(outcome.world, outcome.task, outcome.seed, outcome.policy, outcome.repeat)


def planned_rollouts_of(definition: StudyDefinition) -> Iterator[PlannedRollout]:
    """All rollouts of a study, in the order of its report."""
    for world in (REAL, *definition.imagined):
        repeats = 1 if world == REAL else definition.repeats
        for task in definition.tasks:
            for seed in definition.seeds:
                for policy in definition.policies:
                    yield from (
                        PlannedRollout(world, task, seed, policy, n) for n in range(repeats)
                    )


def study_report(definition: StudyDefinition, results: StudyResults) -> ClosedLoopReport:
    """Scores of the finished rollouts, in an order that does not depend on when they ended.

    Rollouts without a result count as failed, with the error `NotRunYet`.
    """
    ordered = [results.outcomes.get(c) or _not_run(c) for c in planned_rollouts_of(definition)]
    return ClosedLoopReport(
        tuple(one for one in ordered if isinstance(one, RolloutScore)),
        tuple(definition.imagined),
        tuple(definition.policies),
        tuple(one for one in ordered if isinstance(one, RolloutFailure)),
    )


def _not_run(planned: PlannedRollout) -> RolloutFailure:
    message = "no result yet; `dextouch study run` continues the study"
    return RolloutFailure(**planned._asdict(), error="NotRunYet", message=message)


def rollout_episode_id(header: StudyHeader, planned: PlannedRollout) -> str:
    """Id of the episode of one rollout, derived from the study's digests and the cell."""
    digest = hashlib.sha256(repr((sorted(header.digests.items()), tuple(planned))).encode())
    label = f"{planned.world}-{planned.policy}-{planned.task}-{planned.seed}"
    if planned.repeat:
        label += f"-{planned.repeat}"
    label = re.sub(r"[^a-z0-9_-]+", "_", label.lower())[:_MAX_LABEL]
    return f"rollout-{digest.hexdigest()[:10]}-{label}"


def _line(row: Mapping[str, object]) -> bytes:
    return json.dumps(row, allow_nan=False).encode() + b"\n"


def keep_rollout(
    store: EpisodeStore,
    header: StudyHeader,
    planned: PlannedRollout,
    start: MatchedStart,
    played: PlayedRollout,
    world: WorldDescription,
) -> None:
    """Store a rollout, unless a killed run of the study has done so already.

    `success` is the one reported by the world itself, never the probe's estimate.
    """
    episode_id = rollout_episode_id(header, planned)
    if store.exists(episode_id):
        return
    is_digest = re.fullmatch(r"[0-9a-f]{64}", world.digest) is not None
    attributes = EpisodeAttributes(
        episode_id=episode_id,
        task=planned.task,
        instruction=start.instruction,
        domain="robot",
        origin=_ORIGINS.get(world.kind, "imagined"),
        seed=planned.seed,
        model_rate_hz=world.model_rate_hz,
        anchor=StoredAnchor.from_poses(start.anchor),
        K_head=matrix_rows(start.K_head),
        success=played.success,
        quality=played.uncertainty.to_quality(),
        trace_id=played.trace_id,
        lineage=(
            LineageEntry(kind="rollout", id=f"{header.name}: {planned.policy} in {planned.world}"),
            LineageEntry(
                kind="checkpoint", id=world.name, sha256=world.digest if is_digest else None
            ),
        ),
    )
    write_rollout(
        store,
        attributes,
        played.observations,
        played.commanded,
        layout=TactileLayout.of(world.tactile_layout),
    )
