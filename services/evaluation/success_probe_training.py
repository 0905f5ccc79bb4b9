"""Episodes with known success in; a success probe with its held-out accuracy out."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch.nn import functional

from dextouch.errors import InvalidInputError
from services.evaluation.checkpoints import Checkpoint, CheckpointMetadata
from services.evaluation.demonstrations import (
    Demonstration,
    data_hash,
    instructions_of,
    split_by_seed,
)
from services.evaluation.progress import Progress
from services.evaluation.success_probe import (
    KIND,
    NUM_SEEN_STEPS,
    Ending,
    ProbeBatch,
    ProbeNetwork,
    ProbeShape,
    probe_batch,
)

# Windows that end this early cannot be a success: nothing was done yet.
EARLY_ENDS = (2, 8, 14)
LATE_SHIFTS = (0, 1)


class ProbeSettings(BaseModel):
    """How to train a success probe."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    seed: int = 0
    num_training_steps: int = Field(default=1200, ge=1)
    max_cpu_s: float = Field(default=200.0, gt=0)
    batch_size: int = Field(default=64, ge=2)
    learning_rate: float = Field(default=1e-3, gt=0)
    weight_decay: float = Field(default=1e-2, ge=0)
    image_noise: float = Field(default=0.03, ge=0)
    brightness: float = Field(default=0.08, ge=0)
    shift_px: int = Field(default=2, ge=0)
    held_out_share: float = Field(default=0.2, gt=0, lt=1)


@dataclass(frozen=True)
class Labelled:
    """Endings as tensors, whether each is a success, and how much it counts."""

    batch: ProbeBatch
    success: torch.Tensor
    weight: torch.Tensor

    def __len__(self) -> int:
        return len(self.success)


def final_ending(item: Demonstration, end: int) -> Ending:
    """The three steps of an episode up to and including step `end`."""
    steps = slice(end - NUM_SEEN_STEPS + 1, end + 1)
    return Ending(item.images[steps], item.tactile_kpa[steps], item.task)


def labelled_endings(
    demonstrations: Sequence[Demonstration], shape: ProbeShape, *, with_early: bool
) -> Labelled:
    """Endings with their outcome, weighted so that both outcomes count the same in every task.

    Args:
        demonstrations: episodes with known success.
        shape: of the probe.
        with_early: add endings from the beginning of the episodes as failures, and ones that
            stop a step earlier.

    Raises:
        InvalidInputError: a task of which only one outcome is known.
    """
    endings: list[Ending] = []
    success: list[bool] = []
    for item in demonstrations:
        last = item.num_steps - 1
        for shift in LATE_SHIFTS if with_early else (0,):
            endings.append(final_ending(item, last - shift))
            success.append(item.success)
        for end in EARLY_ENDS if with_early else ():
            endings.append(final_ending(item, end))
            success.append(False)
    weight = np.zeros(len(endings))
    labels = np.array(success)
    for task in shape.tasks:
        of_task = np.array([e.task == task for e in endings])
        for outcome in (True, False):
            chosen = of_task & (labels == outcome)
            if not chosen.any():
                word = "successful" if outcome else "failed"
                raise InvalidInputError(
                    f"success probe: no {word} episode of {task!r} among "
                    f"{len(demonstrations)}; record with more noise levels"
                )
            weight[chosen] = 0.5 / chosen.sum()
    return Labelled(
        probe_batch(endings, shape),
        torch.tensor(labels, dtype=torch.float32),
        torch.tensor(weight / weight.mean(), dtype=torch.float32),
    )


def train_success_probe(
    demonstrations: Sequence[Demonstration], settings: ProbeSettings, *, command: str
) -> Checkpoint:
    """Learn to tell success from the last three steps.

    Returns:
        The weights, with accuracy on held-out seeds in the metadata (true endings only).
    """
    torch.manual_seed(settings.seed)
    tasks = tuple(sorted({d.task for d in demonstrations}))
    shape = ProbeShape(tasks=tasks, image_size_px=demonstrations[0].images.shape[1])
    training, held_out = split_by_seed(demonstrations, held_out_share=settings.held_out_share)
    learned = labelled_endings(training, shape, with_early=True)
    tested = labelled_endings(held_out, shape, with_early=False)
    network = ProbeNetwork(shape)
    cpu_s = _optimize(network, learned, settings)
    metadata = CheckpointMetadata(
        kind=KIND,
        command=command,
        seed=settings.seed,
        data_hash=data_hash(demonstrations),
        tasks=tasks,
        training_episodes=tuple(d.episode_id for d in training),
        training_starts=tuple(sorted({d.start_digest for d in training})),
        settings={
            "shape": shape.model_dump(),
            "training": settings.model_dump(),
            "instructions": instructions_of(demonstrations),
        },
        metrics={
            "training_cpu_s": round(cpu_s, 1),
            "num_training_episodes": len(training),
            "num_held_out_episodes": len(held_out),
            **_accuracies(network, tested, shape),
        },
    )
    tensors = {f"network.{name}": t.clone() for name, t in network.state_dict().items()}
    return Checkpoint(metadata, tensors)


def _optimize(network: ProbeNetwork, learned: Labelled, settings: ProbeSettings) -> float:
    """Minimize the balanced cross entropy; gives the CPU seconds it took."""
    generator = torch.Generator().manual_seed(settings.seed)
    optimizer = torch.optim.AdamW(
        network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
    )
    network.train()
    started = time.process_time()
    with Progress("probe", settings.num_training_steps) as progress:
        for step in range(settings.num_training_steps):
            elapsed = time.process_time() - started
            done = max(step / settings.num_training_steps, elapsed / settings.max_cpu_s)
            if done >= 1:
                break
            for group in optimizer.param_groups:
                group["lr"] = settings.learning_rate * 0.5 * (1 + np.cos(np.pi * done))
            index = torch.multinomial(
                learned.weight, settings.batch_size, replacement=True, generator=generator
            )
            images = _disturb(learned.batch.images[index], settings, generator)
            odds = network(
                ProbeBatch(images, learned.batch.touch[index], learned.batch.task[index])
            )
            loss = functional.binary_cross_entropy_with_logits(odds, learned.success[index])
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            progress.advance(loss=float(loss.detach()))
    network.eval()
    return time.process_time() - started


def _disturb(
    images: torch.Tensor, settings: ProbeSettings, generator: torch.Generator
) -> torch.Tensor:
    """Noise, brightness, a small shift, and for half the examples a blur: as models imagine."""
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


def _accuracies(
    network: ProbeNetwork, tested: Labelled, shape: ProbeShape
) -> dict[str, float | int]:
    """Share of right decisions, plain and balanced over outcomes, over all tasks and by task."""
    with torch.no_grad():
        right = (network(tested.batch) > 0) == (tested.success > 0.5)
    figures: dict[str, float | int] = {"held_out_accuracy": float(right.float().mean())}
    positive = tested.success > 0.5
    for index, task in enumerate(shape.tasks):
        of_task = tested.batch.task == index
        shares = [
            right[of_task & (positive == outcome)].float().mean() for outcome in (True, False)
        ]
        figures[f"held_out_balanced_accuracy_{task}"] = float(torch.stack(shares).mean())
        figures[f"num_held_out_successes_{task}"] = int((of_task & positive).sum())
        figures[f"num_held_out_failures_{task}"] = int((of_task & ~positive).sum())
    return figures
