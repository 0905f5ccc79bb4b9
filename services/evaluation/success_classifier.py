"""Success classifier: classifies the end of a rollout as success or failure.

Its inputs are images, touch and, for imagined endings, the predicted object poses; never actions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32, Float64

from dextouch.errors import InvalidInputError
from services.evaluation.calibration import UNFITTED, Calibration, Combination, sigmoid
from services.evaluation.checkpoints import Checkpoint, load_checkpoint, load_network
from services.evaluation.endings import Ending
from services.evaluation.judge_network import (
    ClassifierBatch,
    ClassifierNetwork,
    ClassifierShape,
    probe_batch,
)

# Version 4 of the network, one per task; older checkpoints are rejected by this name.
KIND = "success-probe-4"
DECISION_THRESHOLD = 0.5
Decision = Literal["success", "failure", "cannot tell"]
TRUE, IMAGINED = "true", "imagined"
_BATCH = 256


@dataclass(frozen=True)
class Verdict:
    """Decision of the probe about one ending.

    `probability` is the probe's, joined with the world's own estimate `world_probability` where an
    imagined ending has one. `likely_success` is the more probable outcome, also where the probe
    abstains; `reason` says why it does. `milestones` are the probabilities that each was reached by
    the end, for those that the probe can classify.
    """

    probability: float
    decision: Decision
    likely_success: bool
    reason: str | None = None
    milestones: Mapping[str, float] = field(default_factory=dict)
    world_probability: float | None = None


class SuccessClassifier:
    """A trained probe.

    Args:
        checkpoint: from `load_checkpoint` or from training.

    Raises:
        InvalidInputError: the weights do not match the shape in the metadata.
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
        self._told: Mapping[str, Sequence[str]] = settings.get("told_milestones", {})
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

        Raises:
            UnknownNameError: a task that the probe was not trained for.
            InvalidInputError: no endings, images of another size, or missing images.
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

    def probability(self, ending: Ending) -> float:
        """Probability of success of one ending."""
        return float(self.probabilities([ending])[0])

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
            name: float(reached[index])
            for index, name in enumerate(names)
            if name in self._told.get(ending.task, ())
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
        """Probability of success by all that is known, and why nothing is decided from it.

        Args:
            ending: what is judged.
            probability: calibrated, of the probe alone.
        """
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
        if ending.doubted is not None:
            return probability, f"the world flags its prediction: {ending.doubted}"
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
