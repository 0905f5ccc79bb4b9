"""Closed-loop evaluation: rolls out policies in worlds from matched starts and scores them.

Imagined worlds start from exactly the first observation, anchor and camera of the real one. Real
success is reported by the real world, imagined success is the probe's decision on the ending.
"""

import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from dextouch.clients import Policy, Rollout
from dextouch.errors import ConflictError, DexTouchError, InvalidInputError, StorageError
from dextouch.schemas import (
    MAX_SEED,
    Observation,
    ReturnSelector,
    RolloutUncertainty,
    reported_milestones,
    rollout_uncertainty,
)
from dextouch.streams import HEAD_CAMERA
from dextouch.tracing import current_trace_id, in_trace
from services.evaluation.endings import NUM_SEEN_STEPS, Ending
from services.evaluation.matched_starts import (
    FailedStart,
    MatchedStart,
    StudyWorlds,
    WorldAddress,
    first_digest,
    matched_start,
    refuse_training_starts,
    rollout_failure,
)
from services.evaluation.policies.outside import action_chunk, ask
from services.evaluation.progress import Progress
from services.evaluation.rating.marks import Rubric, read_rubrics
from services.evaluation.scores import REAL, ClosedLoopReport, Outcome, RolloutFailure, RolloutScore
from services.evaluation.success_classifier import SuccessClassifier

# Repeats of an imagined rollout differ by this in the seed of their noise.
_REPEAT_STRIDE = 2**40


@dataclass(frozen=True)
class EvaluationPlan:
    """Tasks, seeds and length of an evaluation.

    `instructions` maps every task to its instruction; every rollout lasts `num_steps` steps of the
    model grid, whatever the length of a policy's chunks; `trained_on` maps each trained component
    (world model, policy, probe) to digests of its training starts, which the evaluation rejects.
    """

    instructions: Mapping[str, str]
    seeds: Sequence[int]
    num_steps: int = 80
    trained_on: Mapping[str, Iterable[str]] = field(default_factory=dict)


def evaluate(
    *,
    real: WorldAddress,
    imagined: Mapping[str, WorldAddress],
    policies: Mapping[str, Policy],
    plan: EvaluationPlan,
    probe: SuccessClassifier,
    keep: Callable[[Outcome], None] | None = None,
) -> ClosedLoopReport:
    """Roll out every policy from every start in every world, by their names in the report.

    There may be no imagined world. `keep` is called with every outcome as soon as it is known.

    Raises:
        ConflictError: a start was trained on.
        UnknownNameError: unknown world or task.
        InvalidInputError: nothing to evaluate, or worlds that do not match each other or the plan.
        UnavailableError: a world cannot be reached at the beginning.
    """
    if not policies or not plan.instructions or not plan.seeds:
        raise InvalidInputError(
            f"evaluation: got {len(policies)} policies, {len(plan.instructions)} tasks and "
            f"{len(plan.seeds)} seeds; expected at least one of each"
        )
    worlds = StudyWorlds.ask(real, imagined)
    worlds.check(list(plan.instructions), plan.num_steps, probe.shape.image_size_px)
    starts = begin_matched(real, plan, probe)
    scores: list[RolloutScore] = []
    failures: list[RolloutFailure] = []
    runner = RolloutRunner(worlds, probe, plan.num_steps)
    cells = list(itertools.product(starts, policies, worlds.addresses))
    with Progress("rollouts", len(cells)) as progress:
        for start, policy, world in cells:
            outcome, _ = runner.run(start, policies[policy], policy, world)
            if keep is not None:
                keep(outcome)
            if isinstance(outcome, RolloutScore):
                scores.append(outcome)
            else:
                failures.append(outcome)
            progress.advance(failed=float(len(failures)))
    return ClosedLoopReport(tuple(scores), tuple(imagined), tuple(policies), tuple(failures))


def begin_matched(
    real: WorldAddress, plan: EvaluationPlan, probe: SuccessClassifier
) -> list[MatchedStart | FailedStart]:
    """Start every task and seed once in the real world.

    Raises ConflictError if a start was trained on.
    """
    starts = [
        matched_start(real, task, seed, instruction)
        for task, instruction in plan.instructions.items()
        for seed in plan.seeds
    ]
    digests = [start.digest for start in starts if isinstance(start, MatchedStart)]
    trained_on = {**plan.trained_on, "the success classifier": probe.metadata.training_starts}
    for what, trained in trained_on.items():
        refuse_training_starts(digests, trained_on=trained, what=what)
    return starts


@dataclass(frozen=True)
class PlayedRollout:
    """What happened in a finished rollout.

    `observations` are those of step 0 and of every chunk; `commanded` [T, 67] are the actions, row
    0 the poses of step 0; `success` is the world's own report, None if it has none. `milestones`
    are 1 for those of the task that a chunk reached, by its own report. `trace_id` is that of its
    requests.
    """

    observations: Sequence[Observation]
    commanded: Float64[np.ndarray, "steps 67"]
    success: bool | None
    trace_id: str | None = None
    milestones: Mapping[str, float] = field(default_factory=dict)

    @property
    def ending(self) -> Observation:
        """The observation of the last chunk."""
        return self.observations[-1]

    @property
    def uncertainty(self) -> RolloutUncertainty:
        """The world's uncertainty of the whole rollout."""
        return rollout_uncertainty(self.observations)


@dataclass(frozen=True)
class RolloutRunner:
    """Runs rollouts one at a time; not thread-safe, as its connections are not.

    `own_probes` are success classifiers that were calibrated for single worlds, by world; `probe`
    judges all others. With `shows_all` the head camera's images of all steps are requested;
    otherwise worlds render only the images that the policy uses, and the ending.
    """

    worlds: StudyWorlds
    probe: SuccessClassifier
    num_steps: int
    shows_all: bool = False
    own_probes: Mapping[str, SuccessClassifier] = field(default_factory=dict)
    rubrics: Mapping[str, Rubric] = field(default_factory=read_rubrics)

    def run(
        self,
        start: MatchedStart | FailedStart,
        actor: Policy,
        policy: str,
        world: str,
        repeat: int = 0,
    ) -> tuple[Outcome, PlayedRollout | None]:
        """Outcome of one rollout of a policy, and what happened unless it failed.

        An error becomes a failure with its reason. Imagined worlds give each repeat its own noise.
        """
        if isinstance(start, FailedStart):
            return rollout_failure(start.error, start, policy, world, repeat), None
        try:
            with in_trace():
                played = self._play(start, actor, policy, world, repeat)
            ending = Ending.of(
                played.ending, start.task, imagined=world != REAL, uncertainty=played.uncertainty
            )
            verdict = self.own_probes.get(world, self.probe).verdict(ending)
        except DexTouchError as error:
            return rollout_failure(error, start, policy, world, repeat), None
        milestones = played.milestones if world == REAL else verdict.milestones
        rubric = self.rubrics.get(start.task)
        score = RolloutScore(
            world,
            policy,
            start.task,
            start.seed,
            start.digest,
            verdict.likely_success if played.success is None else played.success,
            verdict.probability,
            cannot_tell=None if played.success is not None else verdict.reason,
            repeat=repeat,
            world_probability=verdict.world_probability,
            rubric_score=None if rubric is None else rubric.score_by_milestones(milestones),
        )
        return score, played

    def _begin(self, start: MatchedStart, policy: str, world: str, repeat: int) -> Rollout:
        address = self.worlds.addresses[world]
        client = address.client.selecting(ReturnSelector(cameras=self.worlds.cameras), name=policy)
        is_real = world == REAL
        rollout = client.start(
            world=address.world,
            task=start.task,
            seed=start.seed if is_real else (start.seed + repeat * _REPEAT_STRIDE) % MAX_SEED,
            instruction=start.instruction,
            init=None if is_real else (start.observation, start.anchor, start.K_head),
            action_kind=start.action_kind,
        )
        if is_real and first_digest(rollout.observation) != start.digest:
            rollout.close()
            raise ConflictError(
                f"world {address.world!r}: task {start.task!r} with seed {start.seed} began "
                "differently than before; matched starts need a deterministic world"
            )
        return rollout

    def _play(
        self, start: MatchedStart, actor: Policy, policy: str, world: str, repeat: int
    ) -> PlayedRollout:
        description = self.worlds.descriptions[world]
        where = f"policy {policy!r}, task {start.task!r}, seed {start.seed}"
        with self._begin(start, policy, world, repeat) as rollout:
            seen = [rollout.observation]
            commanded = [rollout.observation.action_reached[-1:]]
            milestones: dict[str, float] = {}
            # The world's images may be smaller than that of the start.
            given = replace(start.for_policy(), K_head=rollout.K_head)
            ask(actor.reset, given, where=f"{where}: reset")
            while (left := self.num_steps - rollout.info.last_step) > 0:
                acting = f"{where}, chunk {rollout.info.next_chunk}: act"
                answer = ask(actor.act, rollout.observation, where=acting)
                chunk = action_chunk(answer, description, where=acting)[:left]
                commanded.append(chunk)
                images = getattr(actor, "uses_images", True)
                multiple = description.chunk_multiple
                for observation in self._step(
                    rollout, chunk, left, images=images, multiple=multiple
                ):
                    seen.append(observation)
                    for name, value in reported_milestones(rollout.reported).items():
                        milestones[name] = max(value, milestones.get(name, 0.0))
            success = rollout.observation.success if world == REAL else None
        if len(seen[-1]) < NUM_SEEN_STEPS:
            raise InvalidInputError(
                f"{where}: the last chunk has {len(seen[-1])} steps, expected at least "
                f"{NUM_SEEN_STEPS}; send longer chunks"
            )
        return PlayedRollout(
            seen, np.concatenate(commanded), success, current_trace_id(), milestones
        )

    def _step(
        self, rollout: Rollout, chunk: np.ndarray, left: int, *, images: bool | str, multiple: int
    ) -> Iterator[Observation]:
        """Advance by a chunk; images, which take most of the time, only where they are needed."""
        cameras, is_last = self.worlds.cameras, len(chunk) == left
        if self.shows_all or images is True or (images and is_last):
            selector = ReturnSelector(cameras=cameras if images else (HEAD_CAMERA,))
            yield rollout.step(chunk, selector=selector, validated=True)
            return
        if images:
            newest = ReturnSelector(cameras=cameras, steps="last")
            yield rollout.step(chunk, selector=newest, validated=True)
            return
        # Only the ending is rendered, in a chunk of its own.
        num_rendered = -(-NUM_SEEN_STEPS // multiple) * multiple if is_last else 0
        num_blind = max(len(chunk) - num_rendered, 0)
        if num_blind:
            blind = ReturnSelector(cameras=())
            yield rollout.step(chunk[:num_blind], selector=blind, validated=True)
        if num_blind < len(chunk):
            yield rollout.step(chunk[num_blind:], validated=True)


class ResultLog:
    """Appends rollouts one by one to a file, so that an interrupted study keeps its results.

    Rows of earlier studies are kept and distinguished by `study`, the start time of the study.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._study = datetime.now(UTC).isoformat(timespec="milliseconds")

    def keep(self, outcome: RolloutScore | RolloutFailure) -> None:
        """Append one row; raises StorageError if the file cannot be written."""
        row = {"study": self._study, **asdict(outcome)}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row, allow_nan=False) + "\n")
        except OSError as error:
            raise StorageError(
                f"results {self.path}: cannot be written ({error}); choose another --results"
            ) from error
