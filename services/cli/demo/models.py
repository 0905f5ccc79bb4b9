"""Pretrained or freshly trained networks for the demo."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from dextouch.errors import ConflictError
from dextouch.worlds import BatchWorld
from services.cli.demo.settings import TASKS
from services.cli.main import run_command
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.settings import DEFAULT_POLICY, DEFAULT_PROBE
from services.evaluation.success_probe import SuccessProbe
from services.world_model.checkpoints import default_checkpoint
from services.world_model.state_checkpoints import read_state_checkpoint
from services.world_model.world import open_world

DEMONSTRATIONS = ("--mix", "demonstrations")
# Exact demonstrations for the policy: seeds that nothing else uses, no noise, no misses.
EXACT_DATA = ("--first", "1000", "--count", "120", "--exact")
# Endings near the boundary of success for world model and probe, and others for evaluation.
ENDINGS = (
    "--ladder", "--first", "2000", "--count", "315",
    "--miss-fraction", "0.1", "--still-fraction", "0.1",
)  # fmt: skip
UNSEEN_ENDINGS = ("--ladder", "--first", "30000", "--count", "180")
# A small state model: one ensemble member, few steps.
SMALL_STATE_MODEL = (
    "--num-members=1", "--jobs=1", "--reader.num-steps=2500", "--core.num-steps=1500",
    "--drawing.cpu-budget-s=300",
)  # fmt: skip


@dataclass(frozen=True)
class Models:
    """State model with the range of its training seeds by task, closed-loop policy and probe."""

    world_model: BatchWorld[Any]
    training_seeds: Mapping[str, tuple[int, int]]
    policy: BehaviourCloningPolicy
    probe: SuccessProbe


def refuse_trained(training_seeds: Mapping[str, tuple[int, int]], seeds: Iterable[int]) -> None:
    """Refuse to evaluate on seeds used in training.

    Raises:
        ConflictError: the world model was trained on some of these seeds.
    """
    wanted = list(seeds)
    for task, (low, high) in training_seeds.items():
        trained = [seed for seed in wanted if low <= seed <= high]
        if trained:
            raise ConflictError(
                f"world model: trained on {task!r} with seeds {low} … {high}, and the demo "
                f"evaluates on seed {trained[0]}; train it on seeds below 20000"
            )


def committed_models() -> Models:
    """Load the networks shipped with the package.

    Raises:
        NotFoundError, CorruptDataError: a file is missing or damaged.
    """
    return _load(default_checkpoint(), DEFAULT_POLICY, DEFAULT_PROBE)


def train_models(folder: Path) -> Models:
    """Record training episodes and train a small state model, a policy and a success probe.

    The probe is trained on true endings and on those imagined by the state model.

    Args:
        folder: folder of episodes and checkpoints; existing episodes are reused.
    """
    episodes, exact, endings, unseen, imagined = (
        str(folder / name) for name in ("episodes", "exact", "endings", "unseen", "imagined")
    )
    world_model = folder / "state.safetensors"
    policy, probe = folder / "behaviour_cloning.safetensors", folder / "success_probe.safetensors"
    run_command(["train", "data", "--store", episodes, *DEMONSTRATIONS])
    run_command(["train", "data", "--store", exact, *EXACT_DATA])
    run_command(["train", "data", "--store", endings, *ENDINGS])
    run_command(["train", "data", "--store", unseen, *UNSEEN_ENDINGS])
    both = ["--episodes", episodes, "--episodes", endings, "--output", str(world_model)]
    run_command(["train", "state", *both, f"--tasks={','.join(TASKS)}", *SMALL_STATE_MODEL])
    run_command(
        ["train", "policy", "--episodes", exact, "--episodes", episodes, "--output", str(policy)]
    )
    of_world = ["--checkpoint", str(world_model)]
    run_command(["train", "imagined", "--episodes", endings, "--store", imagined, *of_world])
    true_and_imagined = ["--episodes", endings, "--episodes", imagined]
    run_command(
        ["train", "probe", *true_and_imagined, "--held-out", unseen, "--output", str(probe)]
    )
    return _load(world_model, policy, probe)


def use_one_thread() -> None:
    """Limit torch to one thread; more slow down small networks beside busy services."""
    torch.set_num_threads(1)


def _load(world_model: Path, policy: Path, probe: Path) -> Models:
    return Models(
        open_world(world_model),
        read_state_checkpoint(world_model).metadata.training_seeds,
        BehaviourCloningPolicy.load(policy),
        SuccessProbe.load(probe),
    )
