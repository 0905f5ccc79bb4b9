"""Demonstrations in; a behaviour cloning checkpoint with its held-out error out."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field

from dextouch.errors import InvalidInputError
from dextouch.hands.actions import ACTION_DIM, WRIST_LEFT, WRIST_RIGHT, reanchor
from services.evaluation.checkpoints import Checkpoint, CheckpointMetadata
from services.evaluation.demonstrations import (
    Demonstration,
    data_hash,
    instructions_of,
    split_by_seed,
)
from services.evaluation.policies.behaviour_cloning import (
    KIND,
    CloningInput,
    CloningShape,
    cloning_batch,
)
from services.evaluation.policies.cloning_network import (
    CHUNK_STEPS,
    SLOT_STEPS,
    CloningBatch,
    CloningNetwork,
)
from services.evaluation.progress import Progress

# Decisions are learned at these steps; an evaluation with chunks of 16 decides at every second.
DECISION_STRIDE = SLOT_STEPS


class CloningSettings(BaseModel):
    """How to train a cloned policy."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    seed: int = 0
    num_training_steps: int = Field(default=3000, ge=1)
    max_cpu_s: float = Field(default=240.0, gt=0)
    batch_size: int = Field(default=64, ge=1)
    learning_rate: float = Field(default=1.5e-3, gt=0)
    weight_decay: float = Field(default=1e-3, ge=0)
    image_noise: float = Field(default=0.02, ge=0)
    brightness: float = Field(default=0.06, ge=0)
    pose_noise: float = Field(default=0.2, ge=0, description="of the spread of each number")
    held_out_share: float = Field(default=0.12, gt=0, lt=1)


@dataclass(frozen=True)
class Decisions:
    """Moments of decision as tensors, with the chunks that the demonstrator sent next."""

    batch: CloningBatch
    chunks: torch.Tensor

    def __len__(self) -> int:
        return len(self.chunks)

    def pick(self, index: torch.Tensor) -> "Decisions":
        """Some of the moments."""
        return Decisions(self.batch.pick(index), self.chunks[index])


def decisions_of(demonstrations: Sequence[Demonstration], shape: CloningShape) -> Decisions:
    """Every eighth step of successful demonstrations, twice: as measured and as imagined.

    An imagined world senses no joints and answers with the actions it was given, so each moment
    is also learned with the commanded pose in the place of the reached one.

    Raises:
        InvalidInputError: no successful demonstration that is long enough.
    """
    inputs: list[CloningInput] = []
    chunks: list[np.ndarray] = []
    for item in demonstrations:
        if not item.success:
            continue
        for step in range(0, item.num_steps - CHUNK_STEPS, DECISION_STRIDE):
            for measured in (True, False) if step else (True,):
                reached = (item.measured if measured else item.commanded)[step]
                sent = item.commanded[step + 1 : step + 1 + CHUNK_STEPS]
                chunks.append(reanchor(sent, 0, anchor_action=reached))
                inputs.append(
                    CloningInput(
                        item.images[0], item.images[step], item.tactile_kpa[step],
                        reached, measured, step, item.task,
                    )
                )  # fmt: skip
    if not inputs:
        raise InvalidInputError("behaviour cloning: no successful demonstration to imitate")
    return Decisions(
        cloning_batch(inputs, shape), torch.tensor(np.stack(chunks), dtype=torch.float32)
    )


def train_cloned_policy(
    demonstrations: Sequence[Demonstration], settings: CloningSettings, *, command: str
) -> Checkpoint:
    """Imitate the successful demonstrations.

    Returns:
        The weights, with the held-out error beside that of the mean chunk in the metadata.
    """
    torch.manual_seed(settings.seed)
    tasks = tuple(sorted({d.task for d in demonstrations}))
    shape = CloningShape(tasks=tasks, image_size_px=demonstrations[0].images.shape[1])
    training, held_out = split_by_seed(demonstrations, held_out_share=settings.held_out_share)
    learned, tested = decisions_of(training, shape), decisions_of(held_out, shape)
    network = shape.network()
    _fit_statistics(network, learned)
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
            "num_training_decisions": len(learned),
            "num_held_out_decisions": len(tested),
            "training_cpu_s": round(cpu_s, 1),
            **_errors(network, tested),
        },
    )
    tensors = {f"network.{name}": t.clone() for name, t in network.state_dict().items()}
    return Checkpoint(metadata, tensors)


def _fit_statistics(network: CloningNetwork, learned: Decisions) -> None:
    with torch.no_grad():
        network.codec.fit(learned.chunks, learned.batch)
        coefficients = network.codec.encode(learned.chunks, learned.batch)
        network.coefficient_scale.copy_(coefficients.std(0).clamp_min(1e-3))
        reached = network.reached(learned.batch.state)
        network.reached_mean.copy_(reached.mean(0))
        network.reached_scale.copy_(reached.std(0).clamp_min(1e-2))


def _optimize(network: CloningNetwork, learned: Decisions, settings: CloningSettings) -> float:
    """Minimize the weighted action error; gives the CPU seconds it took."""
    generator = torch.Generator().manual_seed(settings.seed)
    optimizer = torch.optim.AdamW(
        network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
    )
    variance = network.codec.encode(learned.chunks, learned.batch).var(0).sum()
    started = time.process_time()
    with Progress("policy", settings.num_training_steps) as progress:
        for step in range(settings.num_training_steps):
            elapsed = time.process_time() - started
            done = max(step / settings.num_training_steps, elapsed / settings.max_cpu_s)
            if done >= 1:
                break
            for group in optimizer.param_groups:
                group["lr"] = settings.learning_rate * 0.5 * (1 + np.cos(np.pi * done))
            index = torch.randint(len(learned), (settings.batch_size,), generator=generator)
            part = learned.pick(index)
            images = _disturb(part.batch.images, settings, generator)
            state = part.batch.state.clone()
            noise = torch.randn((len(state), ACTION_DIM), generator=generator)
            network.reached(state).add_(noise * network.reached_scale * settings.pose_noise)
            guess = network(replace(part.batch, images=images, state=state))
            wanted = network.codec.encode(part.chunks, part.batch)
            loss = (guess - wanted).square().sum(1).mean() / variance
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            progress.advance(loss=float(loss.detach()))
    return time.process_time() - started


def _disturb(
    images: torch.Tensor, settings: CloningSettings, generator: torch.Generator
) -> torch.Tensor:
    """Pixel noise and a random brightness for each example."""
    noise = torch.randn(images.shape, generator=generator) * settings.image_noise
    brightness = torch.randn((len(images), 1, 1, 1), generator=generator) * settings.brightness
    return images + noise + brightness


def _errors(network: CloningNetwork, tested: Decisions) -> dict[str, float]:
    """Wrist error at the end of a held-out chunk, and that of its task's and slot's mean chunk."""
    with torch.no_grad():
        coefficients = network(tested.batch)
        guess = network.codec.decode(coefficients, tested.batch)
        mean = network.codec.decode(torch.zeros_like(coefficients), tested.batch)
    columns = [*range(WRIST_LEFT.start, WRIST_LEFT.start + 3)]
    columns += [*range(WRIST_RIGHT.start, WRIST_RIGHT.start + 3)]
    figures = {}
    for name, chunks in (("", guess), ("_of_mean_chunk", mean)):
        difference = (chunks - tested.chunks)[:, -1, columns].reshape(len(tested), 2, 3)
        figures[f"wrist_error_mm{name}"] = round(1e3 * float(difference.norm(dim=-1).mean()), 2)
    return figures
