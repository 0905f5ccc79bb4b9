"""Training of the success classifier on true and imagined endings of known outcome."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor
from torch.nn import functional

from dextouch.episodes import data_hash, split_by_scene
from dextouch.errors import InvalidInputError
from dextouch.jobs import worker_pool
from services.evaluation.classifier_calibration import (
    classifiable_milestones,
    final_endings,
    fit_calibrations,
    fit_combinations,
    held_out_figures,
)
from services.evaluation.endings import (
    Ending,
    EndingEpisode,
    early_step,
    middle_step,
    milestones_of,
)
from services.evaluation.matched_starts import refuse_training_starts
from services.evaluation.settings import ClassifierSettings
from services.evaluation.success_classifier import (
    DECISION_THRESHOLD,
    KIND,
    TRUE,
    ClassifierBatch,
    ClassifierNetwork,
    ClassifierShape,
    SuccessClassifier,
    TaskNetwork,
    probe_batch,
    unit_images,
)
from services.evaluation.trained_networks import (
    Checkpoint,
    CheckpointMetadata,
    instructions_of,
    network_tensors,
    optimized,
)

# Share of early endings in the weight of a task's failures. They are easy: with more weight they
# would dominate the near misses, which matter.
EARLY_SHARE: Final = 0.1
# Share of middle endings, which train milestones only, in a task's total weight.
MIDDLE_SHARE: Final = 0.15
# Weight of a task's imagined endings relative to its true ones, and that of milestones in the loss;
# chosen.
_IMAGINED_SHARE: Final = 0.4
_MILESTONE_WEIGHT: Final = 0.3
# Augmentation, chosen: noise and brightness of images (standard deviations, of 0 … 1), and noise of
# poses in standard deviations of each feature. At 64 pixels, one pixel is about 10 mm on the table,
# the scale that decides success, so images are shifted by one at most.
_IMAGE_NOISE, _BRIGHTNESS, _POSE_NOISE, _SHIFT_PX = 0.02, 0.05, 0.03, 1
# Shares of true and of imagined endings with both inputs that lose their poses, or their image:
# real endings come without poses, and with poses the network would ignore the image; worlds always
# predict poses, but render images on request.
WITHOUT_POSES: Final = (0.85, 0.3)
WITHOUT_IMAGES: Final = (0.1, 0.3)
# Lower bound of the deviation of features that hardly vary in a task, so that noise stays small.
_LEAST_STD: Final = 0.05


@dataclass(frozen=True)
class Labelled:
    """Endings as tensors, with their outcomes and weights.

    `outcome` [n, outputs] holds success and the task's milestones, `known` marks those that are
    known.
    """

    batch: ClassifierBatch
    outcome: torch.Tensor
    known: torch.Tensor
    weight: torch.Tensor

    def __len__(self) -> int:
        return len(self.outcome)

    def of_task(self, index: int) -> "Labelled":
        """Endings of one task."""
        mine = torch.nonzero(self.batch.task == index)[:, 0]
        return Labelled(self.batch[mine], self.outcome[mine], self.known[mine], self.weight[mine])


@dataclass(frozen=True)
class _Example:
    """`part` is "final", "early" or "middle"; `success` is None in the middle."""

    ending: Ending
    part: str
    success: bool | None
    reached: list[bool] | None


def labelled_endings(
    episodes: Sequence[EndingEpisode], shape: ClassifierShape, *, imagined_share: float = 0.5
) -> Labelled:
    """Endings with outcomes, weighted so that both outcomes count the same in every task.

    Every episode contributes its end and the step before; an early ending, as a failure with a
    tenth of the weight of all failures; and a middle ending where its milestones are known.
    `imagined_share` is the weight of a task's imagined endings relative to its true ones. Raises
    InvalidInputError if a task has only one outcome.
    """
    examples = [example for item in episodes for example in _examples(item, shape)]
    weight = _weights(examples, imagined_share)
    outcome = torch.zeros((len(examples), shape.num_outputs))
    known = torch.zeros((len(examples), shape.num_outputs), dtype=torch.bool)
    for row, example in enumerate(examples):
        if example.success is not None:
            outcome[row, 0], known[row, 0] = float(example.success), True
        if example.reached:
            columns = slice(1, 1 + len(example.reached))
            outcome[row, columns] = torch.tensor(example.reached, dtype=torch.float32)
            known[row, columns] = True
    batch = probe_batch([example.ending for example in examples], shape)
    scaled = torch.tensor(weight / weight.mean(), dtype=torch.float32)
    return Labelled(batch, outcome, known, scaled)


def _examples(item: EndingEpisode, shape: ClassifierShape) -> list[_Example]:
    last = item.last_step
    steps: list[tuple[int, str, bool | None]] = [
        (last, "final", item.success),
        (last - 1, "final", item.success),
        (early_step(item.scene, last), "early", False),
    ]
    names = shape.milestones.get(item.task, ())
    if names and item.event_times_s is not None:
        steps.append((middle_step(item.scene, last), "middle", None))
    return [
        _Example(item.endings[step], part, success, item.reached(names, step))
        for step, part, success in steps
        if step in item.endings
    ]


def _weights(examples: Sequence[_Example], imagined_share: float) -> Float64[np.ndarray, " n"]:
    weight = np.zeros(len(examples))
    group = [(e.ending.task, e.ending.imagined) for e in examples]
    for task, imagined in sorted(set(group)):
        mine = np.array([one == (task, imagined) for one in group])
        both = (task, not imagined) in group
        share = (imagined_share if imagined else 1 - imagined_share) if both else 1.0
        kind = "imagined" if imagined else "true"
        weight[mine] = share * _group_weights(
            [e for e, chosen in zip(examples, mine, strict=True) if chosen], f"{kind} {task!r}"
        )
    return weight


def _group_weights(examples: Sequence[_Example], what: str) -> Float64[np.ndarray, " n"]:
    """Weights of the endings of one task and kind, which sum to one and a little more.

    Where no early steps are shown, final failures have their share of the weight.
    """
    part = np.array([e.part for e in examples])
    success = np.array([bool(e.success) for e in examples])
    weight = np.zeros(len(examples))
    middle = MIDDLE_SHARE if (part == "middle").any() else 0.0
    early = EARLY_SHARE if (part == "early").any() else 0.0
    for word, chosen, share in (
        ("successful", (part == "final") & success, 0.5),
        ("failed", (part == "final") & ~success, 0.5 * (1 - early)),
        ("early", part == "early", 0.5 * early),
        ("middle", part == "middle", middle),
    ):
        if share and not chosen.any():
            raise InvalidInputError(
                f"success classifier: no {word} episode of {what} among {len(examples)} endings; "
                "record with more noise levels"
            )
        weight[chosen] = share / max(chosen.sum(), 1)
    return weight


def object_scale(batch: ClassifierBatch) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and standard deviation of the object pose features, each [features].

    They are 0 and 1 for fewer than two known poses.
    """
    known = batch.objects[batch.has_objects]
    if len(known) < 2:
        return torch.zeros(batch.objects.shape[1]), torch.ones(batch.objects.shape[1])
    return known.mean(dim=0), known.std(dim=0).clamp_min(_LEAST_STD)


@dataclass(frozen=True)
class ClassifierSets:
    """Episodes to train on, to calibrate on, and for metrics; no two sets share a start."""

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
        """The given sets; missing ones are taken from a share of the scenes of `episodes`.

        Raises ConflictError if a held-out or development episode starts like a training episode, or
        is of its scene: an imagined one starts from smaller images than its source.
        """
        training, tested, calibrated = list(episodes), list(held_out), list(development)
        if not tested:
            training, tested = split_by_scene(training, held_out_share=settings.held_out_share)
        if not calibrated:
            training, calibrated = split_by_scene(
                training, held_out_share=settings.development_share, salt="development "
            )
        sets = cls(training, calibrated, tested)
        learned = [*training, *calibrated]
        for others, trained_on in ((calibrated, training), (tested, learned)):
            refuse = partial(refuse_training_starts, what="the success classifier")
            refuse(
                (e.start_digest for e in others), trained_on=(e.start_digest for e in trained_on)
            )
            refuse(
                (e.scene for e in others), trained_on=(e.scene for e in trained_on), noun="scenes"
            )
        return sets

    @property
    def training_starts(self) -> tuple[str, ...]:
        """Digests of the starts of the weights' training or the calibration."""
        return tuple(sorted({e.start_digest for e in (*self.training, *self.development)}))

    def check_measurable(self) -> None:
        """Check before training that every task can be measured.

        Raises InvalidInputError if the held-out true takes of a task that end with images have one
        outcome only.
        """
        for task in sorted({e.task for e in self.training}):
            _, outcomes = final_endings(self.held_out, task, TRUE)
            if len(set(outcomes.tolist())) < 2:
                raise InvalidInputError(
                    f"success classifier: {len(outcomes)} true takes of {task!r} that end with "
                    f"images are held out, {outcomes.sum()} of them successful; expected both "
                    "outcomes: choose a larger --training.held-out-share, or give --held-out STORE"
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

    `development` are the episodes to calibrate on, and `held_out` those of the metrics in the
    metadata; by default each is a share of the scenes of `episodes`, true and imagined ones. Each
    of `jobs` processes trains one task at a time; the weights do not depend on their number. Raises
    ConflictError if a held-out or development episode starts like a training episode, and
    InvalidInputError for a task with only one outcome.
    """
    # As in each of several processes: sums over threads are rounded in another order.
    torch.set_num_threads(1)
    torch.manual_seed(settings.seed)
    sets = ClassifierSets.split(episodes, settings, development=development, held_out=held_out)
    shape = ClassifierShape(
        tasks=tuple(sorted({e.task for e in sets.training})),
        image_size_px=_image_size_px(sets.training),
        milestones=milestones_of(sets.training),
    )
    network = ClassifierNetwork(shape)
    learned = labelled_endings(sets.training, shape, imagined_share=_IMAGINED_SHARE)
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
    calibrated = _calibrated(plain, sets.development, settings)
    figures = held_out_figures(SuccessClassifier(calibrated), sets.held_out)
    return _with(calibrated, "metrics", figures)


def calibrate_success_classifier(
    base: Checkpoint,
    episodes: Sequence[EndingEpisode],
    settings: ClassifierSettings,
    *,
    command: str,
) -> Checkpoint:
    """Fit the probabilities and the bands of a trained probe anew, for another world model.

    The weights and metrics of `base` are kept; they were not trained on the episodes, true and
    imagined ones. So are the probabilities, bands and milestones of tasks without an episode. Of
    the settings only the allowed risks have an effect; those of the checkpoint store the `command`
    as `calibrated_by`.
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
    return _calibrated(checkpoint, episodes, settings)


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
            "instructions": instructions_of(
                (e.task, e.instruction) for e in everything if e.task in shape.tasks
            ),
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
    checkpoint: Checkpoint, development: Sequence[EndingEpisode], settings: ClassifierSettings
) -> Checkpoint:
    def kept(part: Mapping[str, Any]) -> dict[str, Any]:
        tasks = {episode.task for episode in development}
        return {name: one for name, one in part.items() if name.partition("/")[0] not in tasks}

    probe, known = SuccessClassifier(checkpoint), checkpoint.metadata.settings
    calibrations = fit_calibrations(probe, development, risk=settings.risk)
    fitted = {
        "calibration": kept(known.get("calibration", {}))
        | {name: one.model_dump() for name, one in calibrations.items()},
        "classifiable_milestones": classifiable_milestones(probe, development)
        | kept(probe.classifiable_milestones),
    }
    calibrated = _with(checkpoint, "settings", fitted)
    combinations = fit_combinations(
        SuccessClassifier(calibrated),
        development,
        risk=settings.imagined_risk,
        margin=settings.contradiction_margin,
    )
    joined = {name: one.model_dump() for name, one in combinations.items()}
    joined = kept(known.get("combination", {})) | joined
    return _with(calibrated, "settings", {"combination": joined})


def _with(checkpoint: Checkpoint, part: str, added: Mapping[str, object]) -> Checkpoint:
    metadata = checkpoint.metadata
    update = {part: {**getattr(metadata, part), **added}}
    return replace(checkpoint, metadata=metadata.model_copy(update=update))


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
        batch = some_parts(learned.batch[index], network.object_std, generator)
        images = _disturb(unit_images(batch.images), generator)
        odds = network(images, batch)
        return _loss(odds, learned.outcome[index], learned.known[index])

    cpu_s = 0.0
    for used in optimized(network, loss, settings, title=name, max_gradient_norm=math.inf):
        cpu_s = used.cpu_s
    return network.state_dict(), cpu_s


def _loss(odds: torch.Tensor, outcome: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    each = functional.binary_cross_entropy_with_logits(odds, outcome, reduction="none") * known
    success = each[:, 0].sum() / known[:, 0].sum().clamp_min(1)
    milestones = each[:, 1:].sum() / known[:, 1:].sum().clamp_min(1)
    return success + _MILESTONE_WEIGHT * milestones


def some_parts(
    batch: ClassifierBatch,
    object_std: torch.Tensor,
    generator: torch.Generator,
    *,
    without_poses: tuple[float, float] = WITHOUT_POSES,
    without_images: tuple[float, float] = WITHOUT_IMAGES,
) -> ClassifierBatch:
    """Add noise to the poses of examples of one task, and drop poses or images at random.

    `object_std` [features] is the deviation of the task's pose features, the unit of the noise;
    the shares are those of true and of imagined endings.
    """
    drawn = torch.rand(len(batch.task), generator=generator)
    both = batch.has_image & batch.has_objects
    poses, images = (
        torch.where(batch.imagined, imagined, true)
        for true, imagined in (without_poses, without_images)
    )
    no_poses = both & (drawn < poses)
    no_image = both & ~no_poses & (drawn < poses + images)
    noise = torch.randn(batch.objects.shape, generator=generator) * _POSE_NOISE
    return replace(
        batch,
        objects=batch.objects + noise * object_std,
        has_image=batch.has_image & ~no_image,
        has_objects=batch.has_objects & ~no_poses,
    )


def _disturb(images: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Noise, brightness and a small shift, and a blur of half the examples, as in predictions."""
    num = len(images)
    noise = torch.randn(images.shape, generator=generator) * _IMAGE_NOISE
    brightness = torch.randn((num, 1, 1, 1), generator=generator) * _BRIGHTNESS
    blurred = functional.avg_pool2d(
        functional.pad(images, (1, 1, 1, 1), mode="replicate"), 3, stride=1
    )
    choose = torch.rand((num, 1, 1, 1), generator=generator) < 0.5
    images = torch.where(choose, blurred, images) + noise + brightness
    shifts = torch.randint(-_SHIFT_PX, _SHIFT_PX + 1, (2,), generator=generator)
    rows, columns = shifts.tolist()
    return torch.roll(images, (rows, columns), dims=(2, 3))
