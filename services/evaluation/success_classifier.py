"""Success classifier: classifies the end of a rollout as success or failure.

Its inputs are images, touch and, for imagined endings, the predicted object poses; never actions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Final, Literal, cast

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from pydantic import Field
from torch import nn

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.frozen_model import FrozenModel
from services.evaluation.endings import (
    NUM_OBJECT_FEATURES,
    NUM_PAD_FEATURES,
    NUM_SEEN_STEPS,
    Ending,
    object_features,
    pad_features,
)
from services.evaluation.trained_networks import Checkpoint, load_checkpoint, load_network

NUM_TOUCH_FEATURES = 2 * NUM_PAD_FEATURES
_CHANNELS = (24, 32, 48, 48)  # chosen: trains within `max_cpu_s` a task
_OBJECT_HIDDEN, _OBJECT_OUTPUT = 64, 32  # chosen: an object adds fewer features than the image
# Pose features are clipped to this many standard deviations.
_FARTHEST = 5.0
# The band within which everything is undecided.
WHOLE_BAND: Final = 0.5
# Estimates are counted as at most this sure: the mean over a few members is often 0 or 1.
_LEAST_PROBABILITY: Final = 0.01
# Version 4 of the network, one per task; older checkpoints are rejected by this name.
KIND = "success-probe-4"
DECISION_THRESHOLD = 0.5
Decision = Literal["success", "failure", "cannot tell"]
TRUE, IMAGINED = "true", "imagined"
_BATCH = 256


class ClassifierShape(FrozenModel):
    """Shape of the probe's network; stored in the checkpoint.

    `milestones` are the further outputs of each task, in their order.
    """

    tasks: tuple[str, ...]
    hidden: int = 64
    image_size_px: int = 64
    milestones: Mapping[str, tuple[str, ...]] = {}

    @property
    def num_outputs(self) -> int:
        """Success and the milestones of the task with the most of them."""
        return 1 + max((len(names) for names in self.milestones.values()), default=0)


@dataclass(frozen=True)
class ClassifierBatch:
    """Inputs of the network: last images as bytes, touch, features of object poses, task index.

    Missing ones are zero and marked. The network does not see `imagined`, which training uses.
    """

    images: UInt8[torch.Tensor, "n 3 h w"]
    touch: Float32[torch.Tensor, "n 48"]
    objects: Float32[torch.Tensor, "n 105"]
    task: Int64[torch.Tensor, " n"]
    has_image: Bool[torch.Tensor, " n"]
    has_objects: Bool[torch.Tensor, " n"]
    imagined: Bool[torch.Tensor, " n"]

    def __getitem__(self, index: torch.Tensor) -> "ClassifierBatch":
        """Select endings."""
        return ClassifierBatch(*(getattr(self, part.name)[index] for part in fields(self)))


class TaskNetwork(nn.Module):
    """Network of one task: four strided convolutions on the image, two layers on the poses.

    Few image features reach the last layers, so that they encode positions instead of memorizing
    training episodes. Pose features are standardized with the task's `object_mean` and
    `object_std`, which training sets.
    """

    object_mean: torch.Tensor
    object_std: torch.Tensor

    def __init__(self, shape: ClassifierShape) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        for width in _CHANNELS:
            layers.append(nn.Conv2d(channels, width, 3, stride=2, padding=1))
            layers += [nn.BatchNorm2d(width), nn.GELU()]
            channels = width
        side = -(-shape.image_size_px // 2 ** len(_CHANNELS))
        num_features = channels * side * side + NUM_TOUCH_FEATURES + _OBJECT_OUTPUT + 2
        self.eye = nn.Sequential(*layers, nn.Flatten())
        self.objects = nn.Sequential(
            nn.Linear(NUM_OBJECT_FEATURES, _OBJECT_HIDDEN), nn.GELU(),
            nn.Linear(_OBJECT_HIDDEN, _OBJECT_OUTPUT), nn.GELU(),
        )  # fmt: skip
        self.head = nn.Sequential(
            nn.Dropout(0.3), nn.Linear(num_features, shape.hidden), nn.GELU(),
            nn.Linear(shape.hidden, shape.num_outputs),
        )  # fmt: skip
        self.register_buffer("object_mean", torch.zeros(NUM_OBJECT_FEATURES))
        self.register_buffer("object_std", torch.ones(NUM_OBJECT_FEATURES))

    def forward(
        self, images: Float32[torch.Tensor, "n 3 h w"], batch: ClassifierBatch
    ) -> Float32[torch.Tensor, "n outputs"]:
        """Log odds of a batch with images given separately in −0.5 … 0.5."""
        usual = (batch.objects - self.object_mean) / self.object_std
        poses = self.objects(usual.clamp(-_FARTHEST, _FARTHEST))
        has_image, has_objects = batch.has_image[:, None], batch.has_objects[:, None]
        parts = [
            self.eye(images) * has_image,
            poses * has_objects,
            batch.touch,
            has_image.float(),
            has_objects.float(),
        ]
        return torch.as_tensor(self.head(torch.cat(parts, dim=1)))


class ClassifierNetwork(nn.Module):
    """One network per task.

    A network shared by six tasks has to recognize the task in the image before it can resolve
    millimetres: at equal cost it separates stacked from tilted bowls far worse.
    """

    def __init__(self, shape: ClassifierShape) -> None:
        super().__init__()
        self.num_outputs = shape.num_outputs
        self.tasks = nn.ModuleDict({_module_name(task): TaskNetwork(shape) for task in shape.tasks})
        if len(self.tasks) < len(shape.tasks):
            raise InvalidInputError(
                f"success classifier: of the tasks {', '.join(shape.tasks)} two have one name once "
                "'.' is written '%2E'; relabel one of them"
            )

    def of(self, task: str) -> TaskNetwork:
        """The network of one task."""
        return cast("TaskNetwork", self.tasks[_module_name(task)])

    def forward(self, batch: ClassifierBatch) -> Float32[torch.Tensor, "n outputs"]:
        """Log odds [n, outputs] of success and of the milestones of the task."""
        odds = torch.zeros((len(batch.task), self.num_outputs))
        for index, network in enumerate(self.tasks.values()):
            rows = torch.nonzero(batch.task == index)[:, 0]
            if len(rows):
                mine = batch[rows]
                odds[rows] = network(unit_images(mine.images), mine)
        return odds


def _module_name(task: str) -> str:
    """Name of a task's network: `nn.ModuleDict` refuses dots, and names of its own attributes."""
    name = task.replace(".", "%2E")
    return f"%{name}" if hasattr(nn.ModuleDict(), name) else name


def unit_images(images: UInt8[torch.Tensor, "n 3 h w"]) -> Float32[torch.Tensor, "n 3 h w"]:
    """Scale bytes to −0.5 … 0.5."""
    return images.float() / 255 - 0.5


def probe_batch(endings: Sequence[Ending], shape: ClassifierShape) -> ClassifierBatch:
    """Network tensors of endings, for training and prediction alike.

    Raises UnknownNameError for a task that the probe was not trained for, and InvalidInputError for
    images of another size, or neither images nor object poses.
    """
    for ending in endings:
        _check(ending, shape)
    size_px = shape.image_size_px
    nothing = np.zeros((size_px, size_px, 3), np.uint8)
    unknown = np.zeros(NUM_OBJECT_FEATURES, np.float32)
    images = np.stack([nothing if e.images is None else e.images[-1] for e in endings])
    objects = [
        unknown if e.object_poses is None else object_features(e.object_poses) for e in endings
    ]
    touch = pad_features(np.stack([e.tactile_kpa for e in endings]))
    return ClassifierBatch(
        torch.from_numpy(images).permute(0, 3, 1, 2).contiguous(),
        torch.from_numpy(np.concatenate([touch.mean(axis=1), touch[:, -1]], axis=1)),
        torch.from_numpy(np.stack(objects)),
        torch.tensor([shape.tasks.index(e.task) for e in endings]),
        torch.tensor([e.images is not None for e in endings]),
        torch.tensor([e.object_poses is not None for e in endings]),
        torch.tensor([e.imagined for e in endings]),
    )


def _check(ending: Ending, shape: ClassifierShape) -> None:
    size = (NUM_SEEN_STEPS, shape.image_size_px, shape.image_size_px, 3)
    if ending.task not in shape.tasks:
        raise UnknownNameError("task of the success classifier", ending.task, list(shape.tasks))
    if ending.images is None and ending.object_poses is None:
        raise InvalidInputError(
            f"success classifier: an ending of {ending.task!r} has neither images nor object "
            "poses; request the images of the last chunk"
        )
    if ending.images is not None and ending.images.shape != size:
        raise InvalidInputError(
            f"success classifier: got images {ending.images.shape}, expected {size}"
        )


class Calibration(FrozenModel):
    """Probability = sigmoid(log odds / temperature + bias); undecided within `band` of 0.5."""

    temperature: float = Field(default=1.0, gt=0)
    bias: float = 0.0
    band: float = Field(default=0.0, ge=0, lt=0.5)

    def probabilities(self, log_odds: np.ndarray) -> Float64[np.ndarray, " n"]:
        """Calibrated probabilities of success."""
        return sigmoid(np.asarray(log_odds, dtype=np.float64) / self.temperature + self.bias)


class Combination(FrozenModel):
    """Joins the calibrated probability of a classifier with the world's own estimate.

    The log odds of the result are the weighted sum of both log odds and `bias`; it is undecided
    within `band` of 0.5. The two contradict each other if they lie on different sides of 0.5, each
    by more than `margin`; with a margin of 0.5 they never do.
    """

    probe_weight: float = Field(default=0.5, ge=0)
    world_weight: float = Field(default=0.5, ge=0)
    bias: float = 0.0
    band: float = Field(default=0.0, ge=0, le=WHOLE_BAND)
    margin: float = Field(default=0.0, ge=0, le=0.5)

    def probabilities(self, probe: np.ndarray, world: np.ndarray) -> Float64[np.ndarray, " n"]:
        """Joint probabilities of success."""
        odds = self.probe_weight * log_odds_of(probe) + self.world_weight * log_odds_of(world)
        return sigmoid(odds + self.bias)

    def contradictory(self, probe: np.ndarray, world: np.ndarray) -> Bool[np.ndarray, " n"]:
        """Whether classifier and world contradict each other."""
        low, high = np.minimum(probe, world), np.maximum(probe, world)
        return np.asarray((low < 0.5 - self.margin) & (high > 0.5 + self.margin))


# For probes that were trained before their world estimated success: the mean of both log odds, with
# the band outside of which a tenth of the development kinds of mistakes was judged wrongly.
UNFITTED: Final = Combination(band=0.3)


def sigmoid(log_odds: np.ndarray) -> Float64[np.ndarray, "*n"]:
    """1 / (1 + exp(−x)), without overflow."""
    return np.asarray(np.exp(-np.logaddexp(0.0, -log_odds)))


def log_odds_of(probabilities: np.ndarray) -> Float64[np.ndarray, " n"]:
    """Log odds of probabilities that are counted as 0.01 … 0.99."""
    bounded = np.clip(
        np.asarray(probabilities, np.float64), _LEAST_PROBABILITY, 1 - _LEAST_PROBABILITY
    )
    return np.asarray(np.log(bounded / (1 - bounded)))


@dataclass(frozen=True)
class Verdict:
    """Decision of the probe about one ending.

    `probability` is the probe's, joined with the world's own estimate `world_probability` where an
    imagined ending has one. `likely_success` is the more probable outcome, also where
    nothing is decided, for `reason`. `milestones` are the probabilities that each was reached by
    the end, for those that the probe can classify; none is below that of success, which needs all.
    """

    probability: float
    decision: Decision
    likely_success: bool
    reason: str | None = None
    milestones: Mapping[str, float] = field(default_factory=dict)
    world_probability: float | None = None


class SuccessClassifier:
    """A trained probe; `classifiable_milestones` are those of each task that it can classify.

    Raises InvalidInputError if the weights do not match the shape in the metadata.
    """

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.metadata = checkpoint.metadata
        settings = checkpoint.metadata.settings
        self.shape = ClassifierShape.model_validate(settings["shape"])
        self.threshold = float(settings.get("threshold", DECISION_THRESHOLD))
        self._calibrations = {
            name: Calibration.model_validate(values)
            for name, values in settings.get("calibration", {}).items()
        }
        self._combinations = {
            name: Combination.model_validate(values)
            for name, values in settings.get("combination", {}).items()
        }
        self.classifiable_milestones: Mapping[str, Sequence[str]] = settings.get(
            "classifiable_milestones", settings.get("told_milestones", {})
        )
        self._network = ClassifierNetwork(self.shape)
        load_network(self._network, checkpoint)

    @classmethod
    def load(cls, path: Path) -> "SuccessClassifier":
        """Load a probe from its file."""
        return cls(load_checkpoint(path, kind=KIND))

    def calibration(self, task: str, *, imagined: bool) -> Calibration:
        """Calibration of a task's endings.

        Imagined endings use that of true ones if there were none to calibrate on.
        """
        for kind in (IMAGINED, TRUE) if imagined else (TRUE,):
            if (name := calibration_name(task, kind)) in self._calibrations:
                return self._calibrations[name]
        return Calibration()

    def log_odds(self, endings: Sequence[Ending]) -> Float64[np.ndarray, "n outputs"]:
        """Uncalibrated log odds of success and of the task's milestones.

        Raises InvalidInputError without endings, and as `probe_batch`.
        """
        if not endings:
            raise InvalidInputError("success classifier: got no endings, expected at least one")
        parts = [endings[at : at + _BATCH] for at in range(0, len(endings), _BATCH)]
        with torch.no_grad():
            odds = [self._seen(probe_batch(part, self.shape)) for part in parts]
        return torch.cat(odds).double().numpy()

    def _seen(self, batch: ClassifierBatch) -> Float32[torch.Tensor, "n outputs"]:
        """Log odds; with images and poses, the mean of those with and without the images.

        Where poses are known, images rendered from them add as much error as information.
        """
        odds: torch.Tensor = self._network(batch)
        both = batch.has_image & batch.has_objects
        if bool(both.any()):
            unseen = batch[torch.nonzero(both)[:, 0]]
            unseen = replace(unseen, has_image=torch.zeros_like(unseen.has_image))
            odds[both] = (odds[both] + self._network(unseen)) / 2
        return odds

    def probabilities(self, endings: Sequence[Ending]) -> Float64[np.ndarray, " n"]:
        """Calibrated probability of success of each ending, whatever the world estimates.

        Raises as `log_odds`.
        """
        return self._calibrated(endings, self.log_odds(endings))

    def _calibrated(self, endings: Sequence[Ending], odds: np.ndarray) -> Float64[np.ndarray, " n"]:
        found = [self.calibration(e.task, imagined=e.imagined) for e in endings]
        return np.array(
            [float(one.probabilities(row[:1])[0]) for one, row in zip(found, odds, strict=True)]
        )

    def verdicts(self, endings: Sequence[Ending]) -> list[Verdict]:
        """Decision about each ending; raises as `log_odds`."""
        odds = self.log_odds(endings)
        probabilities = self._calibrated(endings, odds)
        return [
            self._verdict(ending, float(probability), row)
            for ending, probability, row in zip(endings, probabilities, odds, strict=True)
        ]

    def verdict(self, ending: Ending) -> Verdict:
        """Decision about one ending."""
        return self.verdicts([ending])[0]

    def _verdict(self, ending: Ending, probability: float, odds: np.ndarray) -> Verdict:
        probability, reason = self._judged(ending, probability)
        likely = probability >= self.threshold
        decided: Decision = "success" if likely else "failure"
        names = self.shape.milestones.get(ending.task, ())
        reached = sigmoid(odds[1:])
        milestones = {
            name: max(float(reached[index]), probability)
            for index, name in enumerate(names)
            if name in self.classifiable_milestones.get(ending.task, ())
        }
        return Verdict(
            probability,
            decided if reason is None else "cannot tell",
            likely,
            reason,
            milestones,
            ending.success_probability,
        )

    def _judged(self, ending: Ending, probability: float) -> tuple[float, str | None]:
        """Probability of success by all that is known, and why nothing is decided from it."""
        band = self.calibration(ending.task, imagined=ending.imagined).band
        contradiction = unknown_size = None
        if ending.success_probability is not None:
            name = combination_name(ending.task, unusual_sizes=ending.has_unusual_sizes)
            joint = self._combinations.get(name, UNFITTED)
            if ending.has_unusual_sizes and name not in self._combinations:
                unknown_size = (
                    f"the size of an object differs by {ending.size_deviation:.0%} from the usual "
                    "one, and the probe was not calibrated on such objects"
                )
            pair = np.array([probability]), np.array([ending.success_probability])
            if joint.contradictory(*pair)[0]:
                contradiction = (
                    f"the probe expects success with probability {probability:.2f}, the world "
                    f"itself with {ending.success_probability:.2f}"
                )
            probability, band = float(joint.probabilities(*pair)[0]), joint.band
        if ending.unreliable is not None:
            return probability, f"the world flags its prediction: {ending.unreliable}"
        if unknown_size is not None:
            return probability, unknown_size
        if contradiction is None and band > 0 and abs(probability - self.threshold) <= band:
            return probability, (
                f"its probability is within {band:.2f} of {self.threshold:g}, where the probe "
                "errs too often"
            )
        return probability, contradiction


def calibration_name(task: str, kind: str) -> str:
    """Key of a task's calibration for true or imagined endings, in checkpoints."""
    return f"{task}/{kind}"


def combination_name(task: str, *, unusual_sizes: bool) -> str:
    """Key of a task's combination for objects of about the usual size or of others."""
    return f"{task}/unusual sizes" if unusual_sizes else task
