"""Training examples of the success classifier: endings as tensors, with labels and weights."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from services.evaluation.endings import Ending, EndingEpisode
from services.evaluation.success_classifier import ClassifierBatch, ClassifierShape, probe_batch

# Share of early endings in the weight of a task's failures. They are easy: with more weight they
# would dominate the near misses, which matter.
EARLY_SHARE: Final = 0.1
# Share of middle endings, which train milestones only, in a task's total weight.
MIDDLE_SHARE: Final = 0.15
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


    Args:
        episodes: episodes with known success.
        shape: shape of the probe.
        imagined_share: weight of a task's imagined endings relative to its true ones.

    Raises:
        InvalidInputError: a task has only one outcome.
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
        (item.early_step, "early", False),
    ]
    names = shape.milestones.get(item.task, ())
    if names and item.event_times_s is not None:
        steps.append((item.middle_step, "middle", None))
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
