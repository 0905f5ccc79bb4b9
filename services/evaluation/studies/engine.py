"""Runs the rollouts of a study, several of each world at a time."""

import hashlib
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from copy import copy
from dataclasses import dataclass, field

from dextouch.clients import Policy
from dextouch.episodes import EpisodeStore, needs, select_episodes
from dextouch.errors import UnavailableError
from services.evaluation.bundled_policies import bundled_policy, checkpoint_of, training_starts_of
from services.evaluation.closed_loop import EvaluationPlan, RolloutRunner, begin_matched
from services.evaluation.matched_starts import FailedStart, MatchedStart, StudyWorlds
from services.evaluation.policies.open_loop import ReplayPolicy
from services.evaluation.policies.user_policies import PolicySource
from services.evaluation.progress import Progress
from services.evaluation.rating.rating_queue import studies_of
from services.evaluation.scores import REAL, ClosedLoopReport, Outcome, RolloutFailure
from services.evaluation.studies.results import (
    PlannedRollout,
    PolicyChoice,
    StudyDefinition,
    StudyHeader,
    StudyResults,
    keep_rollout,
    planned_rollouts_of,
    study_report,
)
from services.evaluation.success_classifier import SuccessClassifier
from services.networks.weight_files import digest_of

Start = MatchedStart | FailedStart


@dataclass(frozen=True)
class StudyParts:
    """What the rollouts of a study need.

    `connect` opens connections to all worlds, and `load_policies` creates all policies by name,
    once per thread, since a policy may keep a state between calls. `probe` judges all worlds that
    have none of their own (`own_probes`). `trained_on` are digests of training starts of each
    trained component, which are refused; without a `store` no rollout is kept.
    """

    connect: Callable[[ExitStack], StudyWorlds]
    load_policies: Callable[[], Mapping[str, Policy]]
    probe: SuccessClassifier
    instructions: Mapping[str, str]
    trained_on: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    store: EpisodeStore | None = None
    own_probes: Mapping[str, SuccessClassifier] = field(default_factory=dict)


def run_study(
    definition: StudyDefinition,
    results: StudyResults,
    parts: StudyParts,
    *,
    retry_failed: bool = False,
) -> ClosedLoopReport:
    """Run the rollouts that have no result yet, and with `retry_failed` failed ones again.

    Equal definitions give equal reports, however often the study was interrupted and however many
    rollouts were in flight, if worlds and policies are deterministic. Every outcome is kept as soon
    as it is known. Raises ConflictError if a start was trained on or the study is being run
    already, and UnavailableError if a world stopped answering.
    """
    with results.locked():
        missing = missing_rollouts(definition, results, retry_failed=retry_failed)
        run_rollouts(definition, missing, results.header, parts, results.keep)
    return study_report(definition, results)


def missing_rollouts(
    definition: StudyDefinition, results: StudyResults, *, retry_failed: bool = False
) -> list[PlannedRollout]:
    """Rollouts of a study that have no result yet, or failed and are to be run again."""
    return [
        planned
        for planned in planned_rollouts_of(definition)
        if planned not in results.outcomes
        or (retry_failed and isinstance(results.outcomes[planned], RolloutFailure))
    ]


def run_rollouts(
    definition: StudyDefinition,
    missing: Sequence[PlannedRollout],
    header: StudyHeader,
    parts: StudyParts,
    keep: Callable[[Outcome], None],
) -> None:
    """Run some rollouts of a study, or of a part of it; raises as `run_study`.

    `keep` is called with each outcome as soon as it is known; the header is the whole study's.
    """
    if missing:
        with ExitStack() as connections:
            worlds = parts.connect(connections)
            size_px = parts.probe.shape.image_size_px
            worlds.check(list(definition.tasks), definition.num_steps, size_px)
            judged = {
                f"the success classifier of world {world!r}": own.metadata.training_starts
                for world, own in parts.own_probes.items()
            }
            plan = EvaluationPlan(
                {task: parts.instructions[task] for task in definition.tasks},
                definition.seeds,
                definition.num_steps,
                trained_on={**parts.trained_on, **judged},
            )
            starts = begin_matched(worlds.addresses[REAL], plan, parts.probe)
            for one in starts:
                if isinstance(one, FailedStart) and isinstance(one.error, UnavailableError):
                    raise one.error
        by_key: dict[tuple[str, int], Start] = {(one.task, one.seed): one for one in starts}
        _Workers(definition, header, parts, by_key).run(missing, keep)


class _Workers:
    """One pool of threads per world, so that each world has rollouts to batch."""

    def __init__(
        self,
        definition: StudyDefinition,
        header: StudyHeader,
        parts: StudyParts,
        starts: Mapping[tuple[str, int], Start],
    ) -> None:
        self._definition, self._header, self._parts = definition, header, parts
        self._starts = starts
        self._local = threading.local()
        self._connections = ExitStack()
        self._lock = threading.Lock()
        self._stopping = threading.Event()

    def run(
        self, planned_rollouts: Sequence[PlannedRollout], keep: Callable[[Outcome], None]
    ) -> None:
        """Run rollouts; `keep` is called with each outcome.

        Raises UnavailableError if a world stopped answering.
        """
        by_world: dict[str, list[PlannedRollout]] = {}
        for planned in planned_rollouts:
            by_world.setdefault(planned.world, []).append(planned)
        num_failed = 0
        with (
            self._connections,
            Progress("rollouts", len(planned_rollouts)) as progress,
            ExitStack() as pools,
        ):
            pending: set[Future[Outcome | None]] = set()
            for world, own in by_world.items():
                pool = ThreadPoolExecutor(self._definition.in_flight, f"rollouts of {world}")
                pools.callback(pool.shutdown, cancel_futures=True)
                pending |= {pool.submit(self._outcome, planned) for planned in own}
            try:
                for future in as_completed(pending):
                    outcome = future.result()
                    if outcome is not None:
                        keep(outcome)
                        num_failed += isinstance(outcome, RolloutFailure)
                        progress.advance(failed=float(num_failed))
            finally:
                # After an error or Ctrl-C, threads end with their current rollout.
                self._stopping.set()

    def _outcome(self, planned: PlannedRollout) -> Outcome | None:
        """Outcome of one rollout; None if the study is stopping."""
        if self._stopping.is_set():
            return None
        runner, policies = self._of_this_thread()
        start = self._starts[planned.task, planned.seed]
        outcome, played = runner.run(
            start, policies[planned.policy], planned.policy, planned.world, planned.repeat
        )
        if isinstance(outcome, RolloutFailure) and outcome.error == UnavailableError.__name__:
            # An unavailable world would fail all further rollouts too.
            runner.worlds.addresses[planned.world].client.worlds()
        store = self._parts.store
        if store is not None and played is not None and isinstance(start, MatchedStart):
            world = runner.worlds.descriptions[planned.world]
            keep_rollout(store, self._header, planned, start, played, world)
        return outcome

    def _of_this_thread(self) -> tuple[RolloutRunner, Mapping[str, Policy]]:
        if not hasattr(self._local, "runner"):
            with self._lock:
                worlds = self._parts.connect(self._connections)
                self._local.policies = self._parts.load_policies()
            self._local.runner = RolloutRunner(
                worlds,
                self._parts.probe,
                self._definition.num_steps,
                shows_all=self._parts.store is not None,
                own_probes=self._parts.own_probes,
            )
        runner: RolloutRunner = self._local.runner
        policies: Mapping[str, Policy] = self._local.policies
        return runner, policies


class PolicyFactory:
    """Creates the policies of a study, those of scripts by `demonstrator`; reads data once.

    Rollouts of the study itself are not replayed.
    """

    def __init__(
        self, definition: StudyDefinition, demonstrator: Callable[[str], ReplayPolicy]
    ) -> None:
        self._definition = definition
        self._replays: dict[str, ReplayPolicy] = {}
        # The store may be the one in which the study keeps its rollouts.
        self._not_own = needs.Need(
            "rollouts of this study",
            "replay a store of demonstrations",
            lambda reader: definition.name not in studies_of(reader.attributes),
            is_choice=True,
        )
        for name, choice in definition.policies.items():
            if choice.script is not None:
                self._replays[name] = demonstrator(choice.script)
            if choice.replay is not None:
                stores, tasks = [EpisodeStore(choice.replay)], definition.tasks
                found = select_episodes(
                    stores, domain="robot", tasks=tasks, origins=(), needs=(self._not_own,)
                )
                self._replays[name] = ReplayPolicy.of(found)

    def load(self) -> dict[str, Policy]:
        """All policies by name, each with a state of its own."""
        return {name: self._load(name, one) for name, one in self._definition.policies.items()}

    def training_starts(self) -> dict[str, tuple[str, ...]]:
        """Digests of training starts of bundled policies, by description."""
        return {
            f"policy {name!r}": training_starts_of(
                bundled_policy(choice.builtin, choice.checkpoint)
            )
            for name, choice in self._definition.policies.items()
            if choice.builtin is not None and checkpoint_of(choice.builtin) is not None
        }

    def digests(self) -> dict[str, str]:
        """Digests of checkpoints and of replayed episodes, which do not cover factories' code."""
        return {
            f"policy {name}": digest
            for name, choice in self._definition.policies.items()
            if (digest := self._digest(choice)) is not None
        }

    def _digest(self, choice: PolicyChoice) -> str | None:
        if choice.builtin is not None:
            path = checkpoint_of(choice.builtin, choice.checkpoint)
            return None if path is None else digest_of(path)
        if choice.replay is None:
            return None
        readers = map(EpisodeStore(choice.replay).open, sorted(EpisodeStore(choice.replay).list()))
        content = [f"{r.item_id} {r.content_sha256}" for r in readers if self._not_own.is_met(r)]
        return hashlib.sha256("\n".join(content).encode()).hexdigest()

    def _load(self, name: str, choice: PolicyChoice) -> Policy:
        if choice.factory is not None:
            return PolicySource.parse(f"{name}={choice.factory}").load(choice.arguments)
        if choice.builtin is not None:
            return bundled_policy(choice.builtin, choice.checkpoint)
        return copy(self._replays[name])
