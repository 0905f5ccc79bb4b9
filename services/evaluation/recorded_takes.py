"""Policies scored in a world model from the first observations of recorded takes.

The takes' own actions, replayed there, show how far its verdicts can be trusted.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from dextouch.clients import Policy
from dextouch.episodes import (
    EpisodeGrid,
    EpisodeReader,
    EpisodeStore,
    Split,
    needs,
    select_episodes,
)
from dextouch.errors import InvalidInputError
from dextouch.images import square_of_at_most
from dextouch.schemas import WorldDescription
from dextouch.streams import HEAD_CAMERA
from services.evaluation import matched_starts
from services.evaluation.closed_loop import RolloutRunner
from services.evaluation.policies.open_loop import ReplayPolicy
from services.evaluation.progress import Progress
from services.evaluation.rendering import rendered
from services.evaluation.scores import ClosedLoopReport, Outcome, RolloutFailure, RolloutScore
from services.evaluation.statistics import area_interval, area_under_roc
from services.evaluation.success_classifier import SuccessClassifier
from services.networks.training_settings import USUAL_IMAGE_PX

IMAGINED: Final = "imagined"
# What a take must have to be replayed.
REPLAYED: Final = (needs.EVERY_PART, needs.WHOLE, needs.OUTCOME, needs.FIRST_IMAGE)
# Name of the replayed actions among the policies.
REPLAY: Final = "recorded actions"
# With fewer takes of either outcome, an area under the curve says little.
LEAST_OF_EACH: Final = 5


@dataclass(frozen=True)
class RecordedTake:
    """A take of known outcome: its first observation, and the actions of its later steps."""

    episode_id: str
    start: matched_starts.MatchedStart
    success: bool
    actions: Float64[np.ndarray, "steps 67"]
    model_rate_hz: float


def read_takes(
    stores: Sequence[EpisodeStore],
    *,
    tasks: Sequence[str] = (),
    splits: Collection[Split] = (),
    most: int | None = None,
    further_views: Sequence[str] = (),
    chunk_multiple: int = 1,
) -> list[RecordedTake]:
    """Robot episodes of known outcome, whatever recorded them; imagined ones are left out.

    Starts have the images of those `further_views` that a take has. Takes without a chunk of
    `chunk_multiple` steps after the first are left out.

    `tasks` and `splits` of scenes are empty for all; of each task the first `most` by their ids are
    read, None for all. Raises NotFoundError and ConflictError as `select_episodes`.
    """
    required = (*REPLAYED, needs.longer_than(chunk_multiple))
    readers = select_episodes(stores, domain="robot", tasks=tasks, splits=splits, needs=required)
    takes: list[RecordedTake] = []
    counts: Counter[str] = Counter()
    for reader in readers:
        task = reader.attributes.task
        counts[task] += 1
        if most is None or counts[task] <= most:
            takes.append(_read_take(reader, len(takes), further_views))
    return takes


def _read_take(reader: EpisodeReader, number: int, further_views: Sequence[str]) -> RecordedTake:
    grid, about = EpisodeGrid(reader), reader.attributes
    start = matched_starts.MatchedStart(
        about.task,
        number,
        about.instruction,
        grid.observation(further_views=further_views),
        grid.anchor,
        grid.K_head,
        grid.action_kind,
    )
    return RecordedTake(about.episode_id, start, grid.success, grid.sent[1:], about.model_rate_hz)


@dataclass(frozen=True)
class RecordedScores:
    """Imagined rollouts from recorded takes: of their own actions, and of policies."""

    takes: tuple[RecordedTake, ...]
    outcomes: tuple[Outcome, ...]
    policies: tuple[str, ...]

    @property
    def failures(self) -> list[RolloutFailure]:
        """Rollouts that did not end."""
        return [one for one in self.outcomes if isinstance(one, RolloutFailure)]

    def scores(self, policy: str, task: str) -> list[RolloutScore]:
        """Finished rollouts of a policy in a task."""
        return [
            one
            for one in self.outcomes
            if isinstance(one, RolloutScore) and (one.policy, one.task) == (policy, task)
        ]

    @property
    def tasks(self) -> tuple[str, ...]:
        """Tasks, in the order of the takes."""
        return tuple(dict.fromkeys(take.start.task for take in self.takes))

    def trust(self, task: str) -> dict[str, Any]:
        """How imagined verdicts of the recorded actions compare with their real outcomes.

        `auc` is that of the probability of success, undecided rollouts included, with its 95 %
        interval (`area_interval`); `wrong` is the share of wrong verdicts among the decided.
        """
        scores = self.scores(REPLAY, task)
        real = np.array([self.takes[one.seed].success for one in scores])
        decided = np.array([one.cannot_tell is None for one in scores], dtype=bool)
        said = np.array([one.success for one in scores])
        figures: dict[str, Any] = {"takes": len(scores), "decided": int(decided.sum())}
        if not len(scores):
            return figures
        figures["real"] = float(real.mean())
        if decided.any():
            figures["imagined"] = float(said[decided].mean())
            figures["wrong"] = float((said != real)[decided].mean())
        if min(real.sum(), (~real).sum()) >= LEAST_OF_EACH:
            probability = np.array([one.probability for one in scores])
            figures["auc"] = area_under_roc(probability, real)
            num_successes = int(real.sum())
            interval = area_interval(figures["auc"], num_successes, len(real) - num_successes)
            figures["auc_interval"] = [interval.low, interval.high]
        return figures

    def policy_row(self, policy: str, task: str) -> dict[str, Any]:
        """Imagined success of a policy among its decided rollouts, with its Wilson interval."""
        scores = tuple(self.scores(policy, task))
        found = ClosedLoopReport(scores, (IMAGINED,), (policy,)).figures(IMAGINED, task, policy)
        num_decided = len(scores) - found.get("undecided", 0)
        row = {"policy": policy, "task": task, "rollouts": len(scores), "decided": num_decided}
        if num_decided:
            row |= {"imagined": found["rate"], "imagined_interval": found["interval"]}
        return row

    def to_report(self) -> dict[str, Any]:
        """All figures and rollouts as plain JSON."""
        return {
            "trust": {task: self.trust(task) for task in self.tasks},
            "policies": [
                self.policy_row(policy, task) for task in self.tasks for policy in self.policies
            ],
            "takes": {take.start.seed: take.episode_id for take in self.takes},
            "rollouts": [asdict(one) for one in self.outcomes if isinstance(one, RolloutScore)],
            "failures": [asdict(one) for one in self.failures],
        }


def score_recorded(
    takes: Sequence[RecordedTake],
    policies: Mapping[str, Policy],
    world: matched_starts.WorldAddress,
    description: WorldDescription,
    probe: SuccessClassifier,
    *,
    trained_on: Mapping[str, Iterable[str]] | None = None,
) -> RecordedScores:
    """Replay every take in a world model, and let every policy act from its first observation.

    Rollouts last as long as their takes, whole chunks of the world; a failed one is recorded as a
    failure, and the others continue. `trained_on` maps trained components, beside the judge, to
    digests of their training starts. Raises ConflictError for a take that was trained on, and
    InvalidInputError for a task, touch, images or a rate that the world or the judge do not know.
    """
    digests = [digest for take in takes for digest in _digests(take.start)]
    judged = {"the success classifier": probe.metadata.training_starts}
    for what, trained in {**judged, **(trained_on or {})}.items():
        matched_starts.refuse_training_starts(digests, trained_on=trained, what=what)
    matched_starts.check_judged_touch({description.name: description})
    multiple = description.chunk_multiple
    for take in takes:
        description.check_rate(take.model_rate_hz, of=f"take {take.episode_id!r}")
        task = take.start.task
        if task not in description.tasks or task not in probe.metadata.settings["instructions"]:
            raise InvalidInputError(
                f"take {take.episode_id!r}: task {task!r} is not one of the world "
                f"({', '.join(description.tasks)}) and of the judge "
                f"({', '.join(probe.metadata.settings['instructions'])}); train both on it, or "
                "choose --tasks"
            )
    if description.image_height_px != probe.shape.image_size_px:
        raise InvalidInputError(
            f"world {description.name!r}: draws images of {description.image_height_px} px, the "
            f"judge sees images of {probe.shape.image_size_px} px; train the judge on what this "
            "world imagined"
        )
    replay = ReplayPolicy({(take.start.task, take.start.seed): take.actions for take in takes})
    actors: dict[str, Policy] = {REPLAY: replay, **policies}
    worlds = matched_starts.StudyWorlds({IMAGINED: world}, {IMAGINED: description})
    outcomes: list[Outcome] = []
    with Progress("imagined rollouts", len(takes) * len(actors)) as progress:
        for take in takes:
            num_steps = len(take.actions) // multiple * multiple
            runner = RolloutRunner(worlds, probe, num_steps)
            for name, actor in actors.items():
                outcomes.append(runner.run(take.start, actor, name, IMAGINED)[0])
                failed = sum(isinstance(one, RolloutFailure) for one in outcomes)
                progress.advance(failed=float(failed))
    return RecordedScores(tuple(takes), tuple(outcomes), tuple(policies))


def _digests(start: matched_starts.MatchedStart) -> tuple[str, ...]:
    """Digests of a start: as recorded, and with the image and touch that worlds make of it."""
    touch = start.observation.tactile_kpa[0]
    images = start.observation.images[HEAD_CAMERA]
    small = square_of_at_most(images, start.K_head, USUAL_IMAGE_PX)[0][0]
    return start.digest, matched_starts.start_digest(small, np.maximum(touch, 0.0))


def score_lines(scores: RecordedScores) -> list[str]:
    """The result as text: first how far to trust it, then the policies."""
    return rendered("recorded.txt.j2", report=scores.to_report()).splitlines()
