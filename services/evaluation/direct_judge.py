"""Direct judge: predicts success from the first observation and the commands alone.

It imagines nothing, so it is the baseline for world models: imagination is useful if imagined
endings predict success better than this judge, trained on the same episodes for as much CPU time.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from services.evaluation.calibration import Calibration
from services.evaluation.checkpoints import Checkpoint, load_checkpoint, load_network
from services.evaluation.direct_network import (
    Attempt,
    DirectNetwork,
    DirectShape,
    attempt_tensors,
)

KIND = "direct-judge-1"
_BATCH = 128


class DirectJudge:
    """A trained direct judge.

    Args:
        checkpoint: from `load_checkpoint` or from training.

    Raises:
        InvalidInputError: the weights do not match the shape in the metadata.
    """

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.metadata = checkpoint.metadata
        settings = checkpoint.metadata.settings
        self.shape = DirectShape.model_validate(settings["shape"])
        self._calibrations = {
            task: Calibration.model_validate(values)
            for task, values in settings.get("calibration", {}).items()
        }
        self._network = DirectNetwork(self.shape)
        load_network(self._network, checkpoint)

    @classmethod
    def load(cls, path: Path) -> "DirectJudge":
        """Load a judge from its file."""
        return cls(load_checkpoint(path, kind=KIND))

    def log_odds(self, attempts: Sequence[Attempt]) -> Float64[np.ndarray, " n"]:
        """Uncalibrated log odds of success.

        Raises:
            UnknownNameError: a task that the judge was not trained for.
            InvalidInputError: no attempts, or images of another size.
        """
        if not attempts:
            raise InvalidInputError("direct judge: got no attempts, expected at least one")
        parts = [attempts[at : at + _BATCH] for at in range(0, len(attempts), _BATCH)]
        with torch.no_grad():
            odds = [self._network(*attempt_tensors(part, self.shape)) for part in parts]
        return torch.cat(odds).double().numpy()

    def probabilities(self, attempts: Sequence[Attempt]) -> Float64[np.ndarray, " n"]:
        """Calibrated probability of success of each attempt; raises as `log_odds`."""
        odds = self.log_odds(attempts)
        found = [self._calibrations.get(one.task, Calibration()) for one in attempts]
        pairs = zip(found, odds, strict=True)
        return np.array([float(one.probabilities(row[None])[0]) for one, row in pairs])
