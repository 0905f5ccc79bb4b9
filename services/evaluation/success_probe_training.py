"""Training of the success probe on endings of known outcome, and its accuracy on held-out ones."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
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
from services.evaluation.starts import refuse_training_starts
from services.evaluation.statistics import area_under_roc, balanced_accuracy
from services.evaluation.success_probe import (
    KIND,
    NUM_SEEN_STEPS,
    Ending,
    ProbeBatch,
    ProbeNetwork,
    ProbeShape,
    probe_batch,
    unit_images,
)

# Windows that end this early cannot be a success: nothing was done yet.
EARLY_ENDS = (2, 8, 14)
LATE_SHIFTS = (0, 1)
# Of the weight of a task's failures. They are easy: with more weight they would crowd out the
# near misses that the probe is there for.
EARLY_SHARE = 0.1


class ProbeSettings(BaseModel):
    """How to train a success probe."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    seed: int = 0
    num_training_steps: int = Field(default=1500, ge=1)
    max_cpu_s: float = Field(default=200.0, gt=0)
    batch_size: int = Field(default=48, ge=2)
    learning_rate: float = Field(default=1.5e-3, gt=0)
    weight_decay: float = Field(default=5e-2, ge=0)
    image_noise: float = Field(default=0.02, ge=0)
    brightness: float = Field(default=0.05, ge=0)
    # At 64 pixels one is about 10 mm on the table, which is what decides success.
    shift_px: int = Field(default=1, ge=0)
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
        with_early: add endings from the beginning of the episodes as failures, with a tenth of
            the weight of all failures, and ones that stop a step earlier.

    Raises:
        InvalidInputError: a task of which only one outcome is known.
    """
    endings: list[Ending] = []
    success: list[bool] = []
    early: list[bool] = []
    for item in demonstrations:
        last = item.num_steps - 1
        for shift in LATE_SHIFTS if with_early else (0,):
            endings.append(final_ending(item, last - shift))
            success.append(item.success)
            early.append(False)
        for end in EARLY_ENDS if with_early else ():
            endings.append(final_ending(item, end))
            success.append(False)
            early.append(True)
    weight = _weights([e.task for e in endings], np.array(success), np.array(early))
    return Labelled(
        probe_batch(endings, shape),
        torch.tensor(success, dtype=torch.float32),
        torch.tensor(weight / weight.mean(), dtype=torch.float32),
    )


def _weights(
    tasks: Sequence[str], success: np.ndarray, early: np.ndarray
) -> Float64[np.ndarray, " n"]:
    weight = np.zeros(len(tasks))
    early_share = EARLY_SHARE if early.any() else 0.0
    for task in sorted(set(tasks)):
        of_task = np.array([name == task for name in tasks])
        for word, chosen, share in (
            ("successful", of_task & success, 1.0),
            ("failed", of_task & ~success & ~early, 1.0 - early_share),
            ("early", of_task & early, early_share),
        ):
            if share and not chosen.any():
                raise InvalidInputError(
                    f"success probe: no {word} episode of {task!r} among "
                    f"{of_task.sum()} endings; record with more noise levels"
                )
            weight[chosen] = share / max(chosen.sum(), 1)
    return weight


def train_success_probe(
    demonstrations: Sequence[Demonstration],
    settings: ProbeSettings,
    *,
    command: str,
    held_out: Sequence[Demonstration] = (),
) -> Checkpoint:
    """Learn to tell success from the end of a rollout.

    Args:
        demonstrations: episodes with known success.
        settings: of the training.
        command: that is kept in the checkpoint.
        held_out: episodes to measure on; without them a share of the seeds of `demonstrations`.

    Returns:
        The weights, with figures of the held-out episodes in the metadata.

    Raises:
        ConflictError: a held-out episode that begins like a training episode.
        InvalidInputError: a task of which only one outcome is known.
    """
    torch.manual_seed(settings.seed)
    shape = ProbeShape(
        tasks=tuple(sorted({d.task for d in demonstrations})),
        image_size_px=demonstrations[0].images.shape[1],
    )
    training, tested = list(demonstrations), list(held_out)
    if not tested:
        training, tested = split_by_seed(demonstrations, held_out_share=settings.held_out_share)
    starts = tuple(sorted({d.start_digest for d in training}))
    refuse_training_starts(
        (d.start_digest for d in tested), trained_on=starts, what="the success probe"
    )
    network = ProbeNetwork(shape)
    cpu_s = _optimize(network, labelled_endings(training, shape, with_early=True), settings)
    metadata = CheckpointMetadata(
        kind=KIND,
        command=command,
        seed=settings.seed,
        data_hash=data_hash([*training, *tested]),
        tasks=shape.tasks,
        training_episodes=tuple(d.episode_id for d in training),
        training_starts=starts,
        settings={
            "shape": shape.model_dump(),
            "training": settings.model_dump(),
            "instructions": instructions_of(demonstrations),
        },
        metrics={
            "training_cpu_s": round(cpu_s, 1),
            "num_training_episodes": len(training),
            "num_held_out_episodes": len(tested),
            **_accuracies(network, labelled_endings(tested, shape, with_early=False), shape),
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
            batch = learned.batch[index]
            images = _disturb(unit_images(batch.images), settings, generator)
            odds = network.judge(images, batch.touch, batch.task)
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
    """Share of right decisions over all tasks; by task AUC, balanced accuracy and counts."""
    with torch.no_grad():
        odds = network(tested.batch).double().numpy()
    success, task_index = tested.success.numpy() > 0.5, tested.batch.task.numpy()
    figures: dict[str, float | int] = {"held_out_accuracy": float(((odds > 0) == success).mean())}
    for index, task in enumerate(shape.tasks):
        scores, positive = odds[task_index == index], success[task_index == index]
        figures[f"held_out_auc_{task}"] = area_under_roc(scores, positive)
        figures[f"held_out_balanced_accuracy_{task}"] = balanced_accuracy(scores > 0, positive)
        figures[f"num_held_out_successes_{task}"] = int(positive.sum())
        figures[f"num_held_out_failures_{task}"] = int((~positive).sum())
    return figures
