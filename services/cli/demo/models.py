"""Committed or freshly trained networks, as the demo uses them."""

from dataclasses import dataclass
from pathlib import Path

import torch

from services.cli import train
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.settings import DEFAULT_POLICY, DEFAULT_PROBE
from services.evaluation.success_probe import SuccessProbe
from services.world_model.checkpoints import Checkpoint, default_checkpoint, read_checkpoint

DEMONSTRATIONS = ("--mix", "demonstrations")
# Exact demonstrations for the policy: seeds that nothing else uses, no noise, no misses.
EXACT_DATA = ("--first", "1000", "--count", "120", "--exact")
# Endings near the border of success for the probe, and others to measure it on.
ENDINGS = (
    "--ladder", "--first", "2000", "--count", "315",
    "--miss-fraction", "0.1", "--still-fraction", "0.1",
)  # fmt: skip
UNSEEN_ENDINGS = ("--ladder", "--first", "30000", "--count", "180")


@dataclass(frozen=True)
class Models:
    """World model, closed-loop policy and success probe."""

    world_model: Checkpoint
    policy: BehaviourCloningPolicy
    probe: SuccessProbe


def committed_models() -> Models:
    """The networks that come with the package.

    Raises:
        NotFoundError, CorruptDataError: a file is missing or damaged.
    """
    return _load(default_checkpoint(), DEFAULT_POLICY, DEFAULT_PROBE)


def train_models(folder: Path) -> Models:
    """Record training episodes and train all three, as the committed ones were trained.

    Args:
        folder: where episodes and checkpoints go; episodes that are there are used again.
    """
    episodes, exact, endings, unseen = (
        str(folder / name) for name in ("episodes", "exact", "endings", "unseen")
    )
    world_model = folder / "world_model.safetensors"
    policy, probe = folder / "behaviour_cloning.safetensors", folder / "success_probe.safetensors"
    train.main(["data", "--store", episodes, *DEMONSTRATIONS])
    train.main(["data", "--store", exact, *EXACT_DATA])
    train.main(["world-model", "--episodes", episodes, "--output", str(world_model)])
    train.main(["policy", "--episodes", exact, "--episodes", episodes, "--output", str(policy)])
    train.main(["data", "--store", endings, *ENDINGS])
    train.main(["data", "--store", unseen, *UNSEEN_ENDINGS])
    train.main(["probe", "--episodes", endings, "--held_out", unseen, "--output", str(probe)])
    return _load(world_model, policy, probe)


def use_one_thread() -> None:
    """One torch thread: beside busy services a second one makes small networks slower."""
    torch.set_num_threads(1)


def _load(world_model: Path, policy: Path, probe: Path) -> Models:
    return Models(
        read_checkpoint(world_model),
        BehaviourCloningPolicy.load(policy),
        SuccessProbe.load(probe),
    )
