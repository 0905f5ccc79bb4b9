"""State of a training run, saved beside its output so that an interrupted run can resume.

One safetensors file holds the weights, their moving average, the optimizer and the random state;
its metadata holds the counters as JSON. The file is replaced atomically, so that a crash at any
time leaves the last complete state. It is removed when the run has ended.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from pydantic import JsonValue, ValidationError
from torch import Tensor

from dextouch.errors import ConflictError, CorruptDataError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import first_problems
from services.networks.weight_files import read_tensors, write_tensors
from services.world_model.settings import TrainSettings

METADATA_KEY: Final = "dextouch_training_state"
SUFFIX: Final = ".resume"
# Settings that may change when a run resumes.
_FREE_SETTINGS: Final = {
    "episodes", "human", "heldout", "output", "json_path", "resume", "state_every_cpu_s", "init",
    "tokenizer", "streaming", "loader_workers", "num_threads", "disjoint_tasks", "new_tasks",
    "device", "wan", "plan",
}  # fmt: skip


class RunFacts(FrozenModel):
    """Metadata of a state.

    `identity` holds the settings and data of the run, `window_numbers` the state of the generator
    that draws windows after the last completed step, as JSON. `log` has rows of step, completed
    fraction of the run, and the video and tactile losses.
    """

    identity: dict[str, JsonValue]
    step: int
    cpu_s: float
    window_numbers: str
    log: tuple[tuple[int, float, float, float], ...]


@dataclass(frozen=True)
class TrainingState:
    """Everything that the next steps of a run depend on.

    Tensor names begin with `model.`, `averaged.` or `optimizer.` (followed by the number of the
    parameter and the name of its moment), or are `generator`.
    """

    tensors: dict[str, Tensor]
    facts: RunFacts


def state_path(output: Path) -> Path:
    """Path of the state of a run with this output."""
    return output.with_name(output.name + SUFFIX)


def identity_of(
    settings: TrainSettings,
    *,
    data_hash: str,
    init_digest: str | None,
    tokenizer_digest: str | None = None,
) -> dict[str, JsonValue]:
    """Settings and data that must not change when a run resumes."""
    kept: dict[str, JsonValue] = settings.model_dump(mode="json", exclude=_FREE_SETTINGS)
    digests = {"init_digest": init_digest, "tokenizer_digest": tokenizer_digest}
    return {**kept, "data_hash": data_hash, **digests}


def write_state(path: Path, state: TrainingState) -> None:
    """Replace the state of a run atomically."""
    write_tensors(path, state.tensors, {METADATA_KEY: state.facts.model_dump_json()})


def read_state(path: Path, identity: Mapping[str, JsonValue]) -> TrainingState:
    """Read the state of a run with these settings and data.

    Raises:
        ConflictError: the state has other settings or data; they are named.
        CorruptDataError: not a training state, or a damaged one.
    """
    where = f"training state {path.name}"
    try:
        tensors, notes = read_tensors(path, where)
    except CorruptDataError as error:
        raise CorruptDataError(f"{error.message}; remove it to start over") from error
    return TrainingState(tensors, checked_facts(notes.get(METADATA_KEY, ""), identity, where))


def checked_facts(text: str, identity: Mapping[str, JsonValue], where: str) -> RunFacts:
    """Metadata of a state, if it is one of a run with these settings and data; as `read_state`."""
    try:
        facts = RunFacts.model_validate_json(text)
    except ValidationError as error:
        raise CorruptDataError(
            f"{where}: unreadable ({first_problems(error)}); remove it to start over"
        ) from error
    expected = json.loads(json.dumps(dict(identity)))
    # Settings that are newer than the state have their defaults.
    saved = {**TrainSettings(episodes="").model_dump(mode="json"), **facts.identity}
    names = facts.identity.keys() | expected.keys()
    others = sorted(n for n in names if saved.get(n) != expected.get(n))
    if others:
        was = {name: saved.get(name) for name in others}
        now = {name: expected.get(name) for name in others}
        raise ConflictError(
            f"{where}: saved by a run with {was}, got {now}; use the settings and episodes of that "
            "run, or omit --resume to start over"
        )
    return facts


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Optimizer moments of every parameter, by name."""
    kept: dict[int, dict[str, Tensor]] = optimizer.state_dict()["state"]
    return {
        f"optimizer.{number}.{name}": moment
        for number, moments in kept.items()
        for name, moment in moments.items()
    }


def moments_like(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Tensors of the names and shapes that `optimizer_tensors` returns after a step of AdamW."""
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    return {
        f"optimizer.{number}.{name}": like
        for number, weight in enumerate(weights)
        for name, like in (("step", torch.zeros(())), ("exp_avg", weight), ("exp_avg_sq", weight))
    }


def restore_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Restore the moments returned by `optimizer_tensors`."""
    moments: dict[int, dict[str, Any]] = {}
    for name, tensor in part_of(tensors, "optimizer.").items():
        number, moment = name.split(".", 1)
        moments.setdefault(int(number), {})[moment] = tensor
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": moments, "param_groups": groups})


def part_of(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Tensors whose names begin with a prefix, without that prefix."""
    return {n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)}
