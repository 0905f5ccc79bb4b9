"""Training of the success classifier on true and imagined endings of known outcome.

Three disjoint sets of episodes: training, development (to calibrate the probabilities) and held out
(for the metrics in the checkpoint).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor
from torch.nn import functional

from dextouch.episodes import data_hash, split_by_scene
from dextouch.errors import InvalidInputError
from dextouch.jobs import worker_pool
from services.evaluation.calibration import (
    Calibration,
    Combination,
    Reliability,
    fit_calibration,
    fit_combination,
    sigmoid,
)
from services.evaluation.endings import Ending, EndingEpisode, milestones_of
from services.evaluation.matched_starts import refuse_training_starts
from services.evaluation.settings import ClassifierSettings
from services.evaluation.statistics import area_under_roc, balanced_accuracy
from services.evaluation.success_classifier import (
    DECISION_THRESHOLD,
    IMAGINED,
    KIND,
    TRUE,
    ClassifierBatch,
    ClassifierNetwork,
    ClassifierShape,
    SuccessClassifier,
    TaskNetwork,
    calibration_name,
    combination_name,
    unit_images,
)
from services.evaluation.success_classifier_data import Labelled, labelled_endings, object_scale
from services.evaluation.trained_networks import (
    Checkpoint,
    CheckpointMetadata,
    instructions_of,
    network_tensors,
    optimized,
)

# Calibration of a trained success classifier, and its metrics on held-out endings.

# No calibration is fitted with fewer endings of either outcome.
MIN_OUTCOMES: Final = 5
# Milestones with a lower area under the ROC curve are not reported by the probe.
MIN_MILESTONE_AUC: Final = 0.9
Figures = dict[str, float | int]


def fit_calibrations(
    probe: SuccessClassifier, episodes: Sequence[EndingEpisode], *, risk: float
) -> dict[str, Calibration]:
    """Calibration of every task and kind of ending with enough of both outcomes."""
    found: dict[str, Calibration] = {}
    for task in probe.shape.tasks:
        for kind in (TRUE, IMAGINED):
            endings, success = final_endings(episodes, task, kind)
            if min(success.sum(), (~success).sum()) < MIN_OUTCOMES:
                continue
            odds = probe.log_odds(endings)[:, 0]
            found[calibration_name(task, kind)] = fit_calibration(odds, success, risk=risk)
    return found


def fit_combinations(
    probe: SuccessClassifier, episodes: Sequence[EndingEpisode], *, risk: float, margin: float
) -> dict[str, Combination]:
    """Combination of a calibrated probe with the world's own estimates, of every task.

    Only imagined endings count that the world estimates and does not doubt, since it is for these
    that the probe decides. Objects of unusual sizes have a combination of their own: a world is
    right about them less often.
    """
    found: dict[str, Combination] = {}
    for task, unusual_sizes in product(probe.shape.tasks, (False, True)):
        endings, success = final_endings(episodes, task, IMAGINED)
        rows = [
            row
            for row, ending in enumerate(endings)
            if ending.success_probability is not None
            and ending.doubted is None
            and ending.has_unusual_sizes == unusual_sizes
        ]
        outcomes = success[rows]
        if min(outcomes.sum(), (~outcomes).sum()) < MIN_OUTCOMES:
            continue
        mine = [endings[row] for row in rows]
        world = np.array([ending.success_probability for ending in mine], dtype=np.float64)
        name = combination_name(task, unusual_sizes=unusual_sizes)
        found[name] = fit_combination(
            probe.probabilities(mine), world, outcomes, risk=risk, margin=margin
        )
    return found


def milestones_that_can_be_told(
    probe: SuccessClassifier, episodes: Sequence[EndingEpisode]
) -> dict[str, tuple[str, ...]]:
    """Milestones of every task that the probe classifies well on held-out endings."""
    areas = milestone_areas(probe, episodes)
    return {
        task: tuple(n for n in names if areas.get((task, n), 0.0) >= MIN_MILESTONE_AUC)
        for task, names in probe.shape.milestones.items()
    }


def milestone_areas(
    probe: SuccessClassifier, episodes: Sequence[EndingEpisode]
) -> dict[tuple[str, str], float]:
    """Area under the ROC curve of every task and milestone with both outcomes."""
    areas: dict[tuple[str, str], float] = {}
    for task, names in probe.shape.milestones.items():
        mine = [e for e in episodes if e.task == task and e.event_times_s is not None]
        if not mine:
            continue
        odds = probe.log_odds([_as_seen(e.final, TRUE) for e in mine])
        for index, name in enumerate(names):
            outcomes = np.array([bool((e.reached(names, e.last_step) or [])[index]) for e in mine])
            if min(outcomes.sum(), (~outcomes).sum()) >= MIN_OUTCOMES:
                areas[task, name] = area_under_roc(odds[:, 1 + index], outcomes)
    return areas


def held_out_figures(probe: SuccessClassifier, episodes: Sequence[EndingEpisode]) -> Figures:
    """Share of correct decisions over all tasks, and metrics of true and imagined endings by task.

    True endings are given without object poses, which a real robot does not have; `poses` are true
    endings with poses and touch but no image; `imagined` endings are given as they are.

    Raises:
        InvalidInputError: a task has only one outcome.
    """
    figures: Figures = {}
    right: list[bool] = []
    for task in probe.shape.tasks:
        endings, success = final_endings(episodes, task, TRUE)
        right.extend(((probe.probabilities(endings) >= probe.threshold) == success).tolist())
        figures |= _figures(probe, endings, success, f"held_out_{{}}_{task}")
        figures[f"num_held_out_successes_{task}"] = int(success.sum())
        figures[f"num_held_out_failures_{task}"] = int((~success).sum())
        for kind, (others, outcomes) in {
            "poses": _with_poses_only(episodes, task),
            "imagined": final_endings(episodes, task, IMAGINED),
        }.items():
            if min(outcomes.sum(), (~outcomes).sum()) >= MIN_OUTCOMES:
                figures |= _figures(probe, others, outcomes, f"held_out_{kind}_{{}}_{task}")
    for (task, name), area in milestone_areas(probe, episodes).items():
        figures[f"held_out_milestone_auc_{task}_{name}"] = area
    return {"held_out_accuracy": float(np.mean(right)), **figures}


def _figures(
    probe: SuccessClassifier, endings: Sequence[Ending], success: np.ndarray, name: str
) -> Figures:
    verdicts = probe.verdicts(endings)
    probabilities = np.array([v.probability for v in verdicts])
    likely = np.array([v.likely_success for v in verdicts])
    decided = np.array([v.decision != "cannot tell" for v in verdicts])
    before = Reliability.of(sigmoid(probe.log_odds(endings)[:, 0]), success)
    after = Reliability.of(probabilities, success)
    found: Figures = {
        "auc": area_under_roc(probabilities, success),
        "balanced_accuracy": balanced_accuracy(likely, success),
        "ece": after.expected_calibration_error,
        "ece_uncalibrated": before.expected_calibration_error,
        "brier": after.brier,
        "brier_uncalibrated": before.brier,
        "undecided": float(1 - decided.mean()),
    }
    if decided.any():
        found["accuracy_of_decided"] = float((likely == success)[decided].mean())
    return {name.format(key): value for key, value in found.items()}


def final_endings(
    episodes: Sequence[EndingEpisode], task: str, kind: str
) -> tuple[list[Ending], Bool[np.ndarray, " n"]]:
    """Final endings of a task, true or imagined, as a probe gets them, and their outcomes."""
    mine = [e for e in episodes if e.task == task and e.imagined == (kind == IMAGINED)]
    success = np.array([e.success for e in mine], dtype=bool)
    return [_as_seen(e.final, kind) for e in mine], success


def _as_seen(ending: Ending, kind: str) -> Ending:
    return replace(ending, object_poses=None) if kind == TRUE and not ending.imagined else ending


def _with_poses_only(
    episodes: Sequence[EndingEpisode], task: str
) -> tuple[list[Ending], Bool[np.ndarray, " n"]]:
    mine = [
        e
        for e in episodes
        if e.task == task and not e.imagined and e.final.object_poses is not None
    ]
    success = np.array([e.success for e in mine], dtype=bool)
    return [replace(e.final, images=None) for e in mine], success


@dataclass(frozen=True)
class ClassifierSets:
    """Disjoint sets of episodes; no two sets share a start."""

    training: Sequence[EndingEpisode]
    development: Sequence[EndingEpisode]
    held_out: Sequence[EndingEpisode]

    @classmethod
    def split(
        cls,
        episodes: Sequence[EndingEpisode],
        settings: ClassifierSettings,
        *,
        development: Sequence[EndingEpisode] = (),
        held_out: Sequence[EndingEpisode] = (),
    ) -> "ClassifierSets":
        """The given sets; missing ones are taken from a share of the scenes of `episodes`."""
        training, tested, calibrated = list(episodes), list(held_out), list(development)
        if not tested:
            training, tested = split_by_scene(training, held_out_share=settings.held_out_share)
        if not calibrated:
            training, calibrated = split_by_scene(
                training, held_out_share=settings.development_share, salt="development "
            )
        return cls(training, calibrated, tested)

    @property
    def training_starts(self) -> tuple[str, ...]:
        """Digests of the starts of the weights' training or the calibration."""
        return tuple(sorted({e.start_digest for e in (*self.training, *self.development)}))

    def check(self) -> None:
        """Raise if two sets share a start.

        Raises:
            ConflictError: a held-out or development episode starts like a training episode.
        """
        learned = {e.start_digest for e in self.training}
        for others, trained_on in (
            (self.development, learned),
            (self.held_out, self.training_starts),
        ):
            refuse_training_starts(
                (e.start_digest for e in others),
                trained_on=trained_on,
                what="the success classifier",
            )

    def check_measurable(self) -> None:
        """Check before training that every task can be measured.

        Raises:
            InvalidInputError: the held-out true takes of a task have one outcome only.
        """
        for task in sorted({e.task for e in self.training}):
            outcomes = [e.success for e in self.held_out if e.task == task and not e.imagined]
            if len(set(outcomes)) < 2:
                raise InvalidInputError(
                    f"success classifier: {len(outcomes)} true takes of {task!r} are held out, "
                    f"{sum(outcomes)} of them successful; expected both outcomes: choose a larger "
                    "--training.held-out-share, or give --held-out STORE"
                )


def train_success_classifier(
    episodes: Sequence[EndingEpisode],
    settings: ClassifierSettings,
    *,
    command: str,
    development: Sequence[EndingEpisode] = (),
    held_out: Sequence[EndingEpisode] = (),
    jobs: int = 1,
) -> Checkpoint:
    """Train a probe to predict success from the end of a rollout.

    Args:
        episodes: true and imagined episodes with known success.
        settings: training settings.
        command: command to store in the checkpoint.
        development: episodes to calibrate on; default: a share of the scenes of `episodes`.
        held_out: episodes to evaluate on; default: a share of the scenes of `episodes`.
        jobs: processes, each of which trains one task at a time; the weights do not depend on it.

    Returns:
        Weights and calibration; the metadata holds the metrics on held-out episodes.

    Raises:
        ConflictError: a held-out or development episode starts like a training episode.
        InvalidInputError: a task has only one outcome.
    """
    torch.manual_seed(settings.seed)
    sets = ClassifierSets.split(episodes, settings, development=development, held_out=held_out)
    sets.check()
    shape = ClassifierShape(
        tasks=tuple(sorted({e.task for e in sets.training})),
        image_size_px=_image_size_px(sets.training),
        milestones=milestones_of(sets.training),
    )
    network = ClassifierNetwork(shape)
    learned = labelled_endings(sets.training, shape, imagined_share=settings.imagined_share)
    sets.check_measurable()
    orders = [
        (network.of(task), learned.of_task(index), settings, f"probe {task}")
        for index, task in enumerate(shape.tasks)
    ]
    cpu_s = 0.0
    for task, (weights, used_s) in zip(shape.tasks, _all_optimized(orders, jobs), strict=True):
        network.of(task).load_state_dict(weights)
        cpu_s += used_s
    network.eval()
    metadata = _metadata(sets, settings, shape, command, cpu_s)
    plain = Checkpoint(metadata, network_tensors(network))
    return _measured(_calibrated(plain, sets, settings), sets)


def calibrate_success_classifier(
    base: Checkpoint,
    episodes: Sequence[EndingEpisode],
    settings: ClassifierSettings,
    *,
    command: str,
) -> Checkpoint:
    """Fit the probabilities and the bands of a trained probe anew, for another world model.

    Args:
        base: its weights and metrics are kept.
        episodes: true and imagined ones of known success, that the weights were not trained on.
        settings: allowed risks; all others have no effect.
        command: command to store in the settings of the checkpoint, as `calibrated_by`.
    """
    metadata = base.metadata
    names = {*metadata.training_episodes, *(e.episode_id for e in episodes)}
    starts = {*metadata.training_starts, *(e.start_digest for e in episodes)}
    known = {
        "training_episodes": tuple(sorted(names)),
        "training_starts": tuple(sorted(starts)),
        "settings": {**metadata.settings, "calibrated_by": command},
    }
    checkpoint = replace(base, metadata=metadata.model_copy(update=known))
    return _calibrated(checkpoint, ClassifierSets((), episodes, ()), settings)


def _image_size_px(episodes: Sequence[EndingEpisode]) -> int:
    images = (e.images for item in episodes for e in item.endings.values())
    return next((int(one.shape[1]) for one in images if one is not None), 64)


def _metadata(
    sets: ClassifierSets,
    settings: ClassifierSettings,
    shape: ClassifierShape,
    command: str,
    cpu_s: float,
) -> CheckpointMetadata:
    everything = [*sets.training, *sets.development, *sets.held_out]
    return CheckpointMetadata(
        kind=KIND,
        command=command,
        seed=settings.seed,
        data_hash=data_hash((e.content_sha256 for e in everything), image_px=shape.image_size_px),
        tasks=shape.tasks,
        training_episodes=tuple(e.episode_id for e in (*sets.training, *sets.development)),
        training_starts=sets.training_starts,
        settings={
            "shape": shape.model_dump(mode="json"),
            "training": settings.model_dump(),
            "instructions": instructions_of(everything),
            "threshold": DECISION_THRESHOLD,
        },
        metrics={
            "training_cpu_s": round(cpu_s, 1),
            "num_training_episodes": len(sets.training),
            "num_imagined_training_episodes": sum(e.imagined for e in sets.training),
            "num_development_episodes": len(sets.development),
            "num_held_out_episodes": len(sets.held_out),
        },
    )


def _calibrated(
    checkpoint: Checkpoint, sets: ClassifierSets, settings: ClassifierSettings
) -> Checkpoint:
    """The checkpoint with all that is fitted to the development episodes."""
    probe = SuccessClassifier(checkpoint)
    calibrations = fit_calibrations(probe, sets.development, risk=settings.risk)
    calibrated = _with_settings(
        checkpoint,
        calibration={name: one.model_dump() for name, one in calibrations.items()},
        told_milestones=milestones_that_can_be_told(probe, sets.development),
    )
    combinations = fit_combinations(
        SuccessClassifier(calibrated),
        sets.development,
        risk=settings.imagined_risk,
        margin=settings.contradiction_margin,
    )
    return _with_settings(
        calibrated, combination={name: one.model_dump() for name, one in combinations.items()}
    )


def _with_settings(checkpoint: Checkpoint, **added: object) -> Checkpoint:
    metadata = checkpoint.metadata
    settings = {**metadata.settings, **added}
    return replace(checkpoint, metadata=metadata.model_copy(update={"settings": settings}))


def _measured(checkpoint: Checkpoint, sets: ClassifierSets) -> Checkpoint:
    """The checkpoint with its metrics on the held-out episodes."""
    figures = held_out_figures(SuccessClassifier(checkpoint), sets.held_out)
    metadata = checkpoint.metadata
    return replace(
        checkpoint,
        metadata=metadata.model_copy(update={"metrics": {**metadata.metrics, **figures}}),
    )


_Order = tuple[TaskNetwork, Labelled, ClassifierSettings, str]
_Optimized = tuple[dict[str, Tensor], float]


def _all_optimized(orders: Sequence[_Order], jobs: int) -> list[_Optimized]:
    if jobs == 1 or len(orders) < 2:
        return [_optimized(*order) for order in orders]
    with worker_pool(jobs, partial(torch.set_num_threads, 1)) as pool:
        running = [pool.submit(_optimized, *order) for order in orders]
        return [one.result() for one in running]


def _optimized(
    network: TaskNetwork, learned: Labelled, settings: ClassifierSettings, name: str
) -> _Optimized:
    """Minimize the balanced cross entropy of one task; returns weights and CPU seconds."""
    # Dropout draws from the global generator.
    torch.manual_seed(settings.seed)
    mean, std = object_scale(learned.batch)
    network.object_mean.copy_(mean)
    network.object_std.copy_(std)

    def loss(generator: torch.Generator) -> torch.Tensor:
        index = torch.multinomial(
            learned.weight, settings.batch_size, replacement=True, generator=generator
        )
        batch = some_parts(learned.batch[index], network.object_std, settings, generator)
        images = _disturb(unit_images(batch.images), settings, generator)
        odds = network(images, batch)
        return _loss(odds, learned.outcome[index], learned.known[index], settings)

    limits = (settings.num_training_steps, settings.max_cpu_s)
    steps = optimized(network, loss, settings, limits=limits, title=name, max_gradient_norm=None)
    cpu_s = 0.0
    for used in steps:
        cpu_s = used.cpu_s
    return network.state_dict(), cpu_s


def _loss(
    odds: torch.Tensor, outcome: torch.Tensor, known: torch.Tensor, settings: ClassifierSettings
) -> torch.Tensor:
    """Cross entropy of success and, with less weight, milestones, where they are known."""
    each = functional.binary_cross_entropy_with_logits(odds, outcome, reduction="none") * known
    success = each[:, 0].sum() / known[:, 0].sum().clamp_min(1)
    milestones = each[:, 1:].sum() / known[:, 1:].sum().clamp_min(1)
    return success + settings.milestone_weight * milestones


def some_parts(
    batch: ClassifierBatch,
    object_std: torch.Tensor,
    settings: ClassifierSettings,
    generator: torch.Generator,
) -> ClassifierBatch:
    """Add noise to the poses, and drop poses or images at random.

    Args:
        batch: examples of one task.
        object_std: [features], deviation of the task's pose features, the unit of the noise.
        settings: dropout shares and noise level.
        generator: source of randomness.
    """
    drawn = torch.rand(len(batch.task), generator=generator)
    both = batch.has_image & batch.has_objects
    without_poses = torch.where(
        batch.imagined, settings.imagined_without_poses, settings.true_without_poses
    )
    without_images = torch.where(
        batch.imagined, settings.imagined_without_images, settings.true_without_images
    )
    no_poses = both & (drawn < without_poses)
    no_image = both & ~no_poses & (drawn < without_poses + without_images)
    noise = torch.randn(batch.objects.shape, generator=generator) * settings.pose_noise
    return replace(
        batch,
        objects=batch.objects + noise * object_std,
        has_image=batch.has_image & ~no_image,
        has_objects=batch.has_objects & ~no_poses,
    )


def _disturb(
    images: torch.Tensor, settings: ClassifierSettings, generator: torch.Generator
) -> torch.Tensor:
    """Noise, brightness and a small shift, and a blur of half the examples, as in predictions."""
    num = len(images)
    noise = torch.randn(images.shape, generator=generator) * settings.image_noise
    brightness = torch.randn((num, 1, 1, 1), generator=generator) * settings.brightness
    blurred = functional.avg_pool2d(
        functional.pad(images, (1, 1, 1, 1), mode="replicate"), 3, stride=1
    )
    choose = torch.rand((num, 1, 1, 1), generator=generator) < 0.5
    images = torch.where(choose, blurred, images) + noise + brightness
    reach = settings.shift_px
    rows, columns = torch.randint(-reach, reach + 1, (2,), generator=generator).tolist()
    return torch.roll(images, (rows, columns), dims=(2, 3))
