"""Results of a study: an append-only file of one JSON line per rollout that can be resumed."""

import fcntl
import hashlib
import json
import os
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from pydantic import TypeAdapter, ValidationError

from dextouch.episodes import EpisodeStore, write_rollout
from dextouch.errors import ConflictError, CorruptDataError, StorageError
from dextouch.schemas import (
    EpisodeAttributes,
    LineageEntry,
    Origin,
    StoredAnchor,
    WorldDescription,
    matrix_rows,
)
from dextouch.tactile.layout import TactileLayout
from services.evaluation.closed_loop import PlayedRollout
from services.evaluation.matched_starts import MatchedStart
from services.evaluation.scores import REAL, ClosedLoopReport, Outcome, RolloutFailure, RolloutScore
from services.evaluation.studies.definition import StudyDefinition

FILE: Final = "results.jsonl"
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
    """The results of one study; open with `create_or_resume`.

    Attributes:
        outcomes: of all finished rollouts by cell.
    """

    def __init__(
        self, path: Path, header: StudyHeader, outcomes: dict[PlannedRollout, Outcome]
    ) -> None:
        self.path = path
        self.header = header
        self.outcomes = outcomes

    @classmethod
    def create_or_resume(cls, folder: Path, header: StudyHeader) -> "StudyResults":
        """Open the results of a study; an incomplete last line of a killed study is removed.

        Raises:
            ConflictError: the folder holds results of another study, or of other worlds or
                policies, or another process is running the study.
            CorruptDataError: a damaged line.
            StorageError: the file cannot be read or written.
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

        Raises:
            StorageError: there are none, or they cannot be read.
            CorruptDataError: a damaged line.
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
                outcomes[cell_of(outcome)] = outcome
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

        Raises:
            StorageError: the file cannot be written.
        """
        try:
            with self.path.open("ab") as file:
                file.write(_line(asdict(outcome)))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise StorageError(f"results {self.path}: cannot be written ({error})") from error
        self.outcomes[cell_of(outcome)] = outcome


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


def cell_of(outcome: Outcome) -> PlannedRollout:
    """The cell that an outcome belongs to."""
    return PlannedRollout(outcome.world, outcome.task, outcome.seed, outcome.policy, outcome.repeat)


def cells_of(definition: StudyDefinition) -> Iterator[PlannedRollout]:
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
    ordered = [results.outcomes.get(c) or _not_run(c) for c in cells_of(definition)]
    return ClosedLoopReport(
        tuple(one for one in ordered if isinstance(one, RolloutScore)),
        tuple(definition.imagined),
        tuple(definition.policies),
        tuple(one for one in ordered if isinstance(one, RolloutFailure)),
    )


def _not_run(cell: PlannedRollout) -> RolloutFailure:
    message = "no result yet; `dextouch study run` continues the study"
    return RolloutFailure(
        cell.world, cell.policy, cell.task, cell.seed, "NotRunYet", message, repeat=cell.repeat
    )


def rollout_episode_id(header: StudyHeader, cell: PlannedRollout) -> str:
    """Id of the episode of one rollout, derived from the study's digests and the cell."""
    digest = hashlib.sha256(repr((sorted(header.digests.items()), tuple(cell))).encode())
    label = f"{cell.world}-{cell.policy}-{cell.task}-{cell.seed}"
    if cell.repeat:
        label += f"-{cell.repeat}"
    label = re.sub(r"[^a-z0-9_-]+", "_", label.lower())[:_MAX_LABEL]
    return f"rollout-{digest.hexdigest()[:10]}-{label}"


def _line(row: Mapping[str, object]) -> bytes:
    return json.dumps(row, allow_nan=False).encode() + b"\n"


def keep_rollout(
    store: EpisodeStore,
    header: StudyHeader,
    cell: PlannedRollout,
    start: MatchedStart,
    played: PlayedRollout,
    world: WorldDescription,
) -> None:
    """Store a rollout, unless a killed run of the study has done so already.

    `success` is the one reported by the world itself, never the probe's estimate.
    """
    episode_id = rollout_episode_id(header, cell)
    if store.exists(episode_id):
        return
    is_digest = re.fullmatch(r"[0-9a-f]{64}", world.digest) is not None
    attributes = EpisodeAttributes(
        episode_id=episode_id,
        task=cell.task,
        instruction=start.instruction,
        domain="robot",
        origin=_ORIGINS.get(world.kind, "imagined"),
        seed=cell.seed,
        model_rate_hz=world.model_rate_hz,
        anchor=StoredAnchor.from_poses(start.anchor),
        K_head=matrix_rows(start.K_head),
        success=played.success,
        quality=played.uncertainty.to_quality(),
        trace_id=played.trace_id,
        lineage=(
            LineageEntry(kind="rollout", id=f"{header.name}: {cell.policy} in {cell.world}"),
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
