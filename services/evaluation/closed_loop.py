"""Closed-loop evaluation: rolls out policies in worlds from matched starts and scores them.

Imagined worlds start from exactly the first observation, anchor and camera of the real one. Real
success is reported by the real world, imagined success is the probe's decision on the ending.
"""

import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from dextouch.clients import Policy, PolicyStart, Rollout
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
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout
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
from services.evaluation.policies.user_policies import action_chunk, ask
from services.evaluation.progress import Progress
from services.evaluation.rating.rubrics import Rubric, read_rubrics
from services.evaluation.reporting.pictures import PredictionPicture
from services.evaluation.scores import REAL, ClosedLoopReport, Outcome, RolloutFailure, RolloutScore

if TYPE_CHECKING:
    # Brings torch, which readers of results need not have.
    from services.evaluation.success_classifier import SuccessClassifier

# Repeats of an imagined rollout differ by this in the seed of their noise.
_REPEAT_STRIDE = 2**40
Pair = tuple[RolloutScore, RolloutScore]


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
    probe: "SuccessClassifier",
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
    real: WorldAddress, plan: EvaluationPlan, probe: "SuccessClassifier"
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
    probe: "SuccessClassifier"
    num_steps: int
    shows_all: bool = False
    own_probes: Mapping[str, "SuccessClassifier"] = field(default_factory=dict)
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
            last = played.observations[-1]
            ending = Ending.of(
                last, start.task, imagined=world != REAL, uncertainty=played.uncertainty
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
            K_head = rollout.K_head
            given = PolicyStart(start.task, start.instruction, start.seed, start.anchor, K_head)
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


def film(
    report: ClosedLoopReport,
    *,
    real: WorldAddress,
    imagined: Mapping[str, WorldAddress],
    policies: Mapping[str, Policy],
    plan: EvaluationPlan,
    probe: "SuccessClassifier",
) -> tuple[PredictionPicture, ...]:
    """Play the example pair of every task again, with the images of all steps.

    The evaluation renders only what policies and the success classifier use. The arguments are
    those of `evaluate`, and `report` what it returned; a pair that fails now is left out, and a
    robot is not moved for a picture.
    """
    if not imagined:
        return ()
    world = report.imagined_worlds[0]
    worlds = StudyWorlds.ask(real, {world: imagined[world]})
    if worlds.descriptions[REAL].kind == "robot":
        return ()
    runner = RolloutRunner(worlds, probe, plan.num_steps, shows_all=True)
    found = []
    for task, pair in example_pairs(report, world).items():
        name, instruction = pair[0].policy, plan.instructions[task]
        start = matched_start(real, task, pair[0].seed, instruction)
        played = [runner.run(start, policies[name], name, one)[1] for one in (REAL, world)]
        finished = [one for one in played if one is not None]
        if len(finished) == 2:
            description = worlds.descriptions[REAL]
            layout = TactileLayout.of(description.tactile_layout) or DEXTOUCH_V1
            found.append(_played_pair(pair, finished, description.model_rate_hz, layout))
    return tuple(found)


def example_pairs(report: ClosedLoopReport, world: str) -> dict[str, Pair]:
    """By task the first start and policy whose outcomes differ, or else succeed in both worlds."""
    known = {(s.world, s.task, s.policy, s.seed): s for s in report.scores if s.repeat == 0}
    found: dict[str, Pair] = {}
    for (where, task, policy, seed), score in known.items():
        imagined = known.get((world, task, policy, seed))
        if where != REAL or imagined is None:
            continue
        pair = (score, imagined)
        if task not in found or _rank(pair) > _rank(found[task]):
            found[task] = pair
    return found


def _rank(pair: Pair) -> tuple[bool, bool]:
    return pair[0].success != pair[1].success, pair[0].success


def title_of(pair: Pair) -> str:
    """Task, policy, start and both outcomes."""
    real, imagined = ("success" if one.success else "failure" for one in pair)
    task = pair[0].task.replace("_", " ")
    return f"{task}, {pair[0].policy}, start {pair[0].seed}: {real} in fact, {imagined} imagined"


def _played_pair(
    pair: Pair, played: list[PlayedRollout], rate_hz: float, layout: TactileLayout
) -> PredictionPicture:
    images = [np.concatenate([o.images[HEAD_CAMERA] for o in one.observations]) for one in played]
    touch = [np.concatenate([o.tactile_kpa for o in one.observations]) for one in played]
    steps = min(map(len, images))
    return PredictionPicture(
        title_of(pair),
        np.arange(steps) / rate_hz,
        images[0][:steps],
        images[1][:steps],
        touch[0][:steps],
        touch[1][:steps],
        layout,
    )
