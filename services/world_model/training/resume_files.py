"""State of a training run, saved beside its output so that an interrupted run can resume.

It is one safetensors file, with the counters as JSON in its metadata. Under torchrun it is a folder
of folders with a file of every process; the counters, in a JSON file beside them, name the newest
complete one. A crash leaves the last complete state.
"""

import json
import os
import shutil
import warnings
from collections.abc import Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from pydantic import JsonValue, ValidationError
from torch import Tensor, distributed, nn
from torch.distributed.checkpoint.hf_storage import (
    HuggingFaceStorageReader,
    HuggingFaceStorageWriter,
)
from torch.distributed.checkpoint.state_dict_loader import load
from torch.distributed.checkpoint.state_dict_saver import save

from dextouch.errors import ConflictError, CorruptDataError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import first_problems
from services.networks.weight_files import read_tensors, write_tensors
from services.world_model.paper_settings import TrainSettings
from services.world_model.training.distribution import Processes

METADATA_KEY: Final = "dextouch_training_state"
SUFFIX: Final = ".resume"
FACTS: Final = "newest.json"
_OPTIMIZER: Final = "optimizer."
# Settings that may change when a run resumes.
_FREE_SETTINGS: Final = {
    "episodes", "human", "heldout", "output", "json_path", "resume", "state_every_s", "init",
    "tokenizer", "streaming", "loader_workers", "num_threads", "disjoint_tasks", "new_tasks",
    "device", "wan", "plan", "plan_processes", "recompute", "accumulate", "replicas",
}  # fmt: skip


class RunFacts(FrozenModel):
    """Counters of a state, and the settings and data of its run; `log` as `TrainingProgress`."""

    identity: dict[str, JsonValue]
    step: int
    cpu_s: float
    wall_s: float
    window_numbers: str
    log: tuple[tuple[int, float, float, float], ...]


@dataclass(frozen=True)
class TrainingState:
    """Everything that the next steps of a run depend on.

    Tensor names begin with `model.`, `averaged.` or `optimizer.` (then moment and weight), or are
    `generator`. Pretrained weights that are not trained are absent.
    """

    tensors: dict[str, Tensor]
    facts: RunFacts


class StateFiles:
    """State of the run that will write this output; all its processes must call each method."""

    def __init__(self, output: Path, processes: Processes) -> None:
        self._file = state_path(output)
        self._folder = self._file.with_name(self._file.name + ".shards")
        self._processes = processes
        self._is_sharded = processes.mesh is not None

    def exists(self) -> bool:
        """Whether there is a state to resume; ConflictError if only of a run started otherwise."""
        single, sharded = self._file.is_file(), (self._folder / FACTS).is_file()
        own, other = (sharded, single) if self._is_sharded else (single, sharded)
        if other and not own:
            raise ConflictError(
                f"training state {self._file.name}: saved by a run "
                f"{'without' if self._is_sharded else 'under'} torchrun; resume it "
                f"{'without it' if self._is_sharded else 'with it, with any number of processes'}"
            )
        return own

    def read(self, identity: Mapping[str, JsonValue], own: Mapping[str, Tensor]) -> TrainingState:
        """Read the state of a run, with tensors as of `own`; sharded weights are loaded in place.

        Raises:
            ConflictError: the state has other settings or data; they are named.
            CorruptDataError: not a training state, or a damaged one.
        """
        if not self._is_sharded:
            where = f"training state {self._file.name}"
            try:
                tensors, notes = read_tensors(self._file, where)
            except CorruptDataError as error:
                raise CorruptDataError(f"{error.message}; remove it to start over") from error
            facts = checked_facts(notes.get(METADATA_KEY, ""), identity, where)
            _check_names(tensors.keys(), own.keys(), where)
            return TrainingState(tensors, facts)
        where = f"training state {self._folder.name}"
        facts = checked_facts((self._folder / FACTS).read_text(), identity, where)
        reader = HuggingFaceStorageReader(str(self._of_step(facts.step)))
        stored = reader.read_metadata().state_dict_metadata
        _check_names(stored.keys(), own.keys(), where)
        # Those of the optimizer have the weights in their place.
        tensors = {
            name: torch.zeros_like(own[name]) if name.startswith(_OPTIMIZER) else own[name]
            for name in stored
        }
        load(tensors, storage_reader=reader)
        return TrainingState(tensors, facts)

    def write(self, state: TrainingState) -> None:
        """Replace the state atomically."""
        if not self._is_sharded:
            facts = state.facts.model_dump_json()
            write_tensors(self._file, state.tensors, {METADATA_KEY: facts})
            return
        target = self._of_step(state.facts.step)
        if self._processes.is_first:
            # Left by a run that was killed while it wrote.
            shutil.rmtree(target, ignore_errors=True)
        distributed.barrier()
        writer = HuggingFaceStorageWriter(str(target), save_distributed=True)
        with warnings.catch_warnings():
            # torch warns of its own use of a deprecated storage.
            warnings.simplefilter("ignore")
            save(state.tensors, storage_writer=writer)
        if self._processes.is_first:
            self._name_newest(state)

    def _name_newest(self, state: TrainingState) -> None:
        partial = self._folder / (FACTS + ".partial")
        with partial.open("w") as file:
            file.write(state.facts.model_dump_json())
            file.flush()
            os.fsync(file.fileno())
        partial.replace(self._folder / FACTS)
        newest = self._of_step(state.facts.step)
        for other in self._folder.iterdir():
            if other.is_dir() and other != newest:
                shutil.rmtree(other)

    def remove(self) -> None:
        """Remove the state of a run that has ended."""
        self._file.unlink(missing_ok=True)
        shutil.rmtree(self._folder, ignore_errors=True)

    def _of_step(self, step: int) -> Path:
        return self._folder / f"step-{step:08d}"


def _check_names(stored: Set[str], own: Set[str], where: str) -> None:
    # A weight without a gradient so far has no moments.
    missing = {name for name in own if not name.startswith(_OPTIMIZER)} - stored
    if missing or stored - own:
        raise CorruptDataError(
            f"{where}: incomplete, or of another release ({len(missing)} tensors missing, "
            f"{len(stored - own)} unexpected); remove it to start over"
        )


def state_path(output: Path) -> Path:
    """Path of the state of a run with this output."""
    return output.with_name(output.name + SUFFIX)


def identity_of(settings: TrainSettings, **digests: str | None) -> dict[str, JsonValue]:
    """Settings, and digests of the data and of files, that must not change when a run resumes.

    Limits of time may change where the learning rate follows the steps.
    """
    free = _FREE_SETTINGS | {"max_steps"}
    if settings.step_limit is not None:
        free |= {"cpu_budget_s", "wall_budget_s"}
    kept = settings.model_dump(mode="json", exclude=free)
    return {**kept, "max_steps": settings.step_limit, **digests}


def checked_facts(text: str, identity: Mapping[str, JsonValue], where: str) -> RunFacts:
    """Metadata of a state, if it is one of a run with these settings and data."""
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
        was, now = ({name: some.get(name) for name in others} for some in (saved, expected))
        raise ConflictError(
            f"{where}: saved by a run with {was}, got {now}; use the settings and episodes of that "
            "run, or omit --resume to start over"
        )
    return facts


def optimizer_tensors(
    optimizer: torch.optim.Optimizer, learned: Mapping[str, nn.Parameter]
) -> dict[str, Tensor]:
    """Optimizer moments of every learned weight, by name; none before its first step."""
    return {
        f"{_OPTIMIZER}{moment}.{name}": value
        for name, weight in learned.items()
        for moment, value in optimizer.state.get(weight, {}).items()
    }


def moments_like(learned: Mapping[str, nn.Parameter]) -> dict[str, Tensor]:
    """Tensors of the names and shapes that `optimizer_tensors` returns after a step of AdamW."""
    return {
        f"{_OPTIMIZER}{moment}.{name}": like
        for name, weight in learned.items()
        for moment, like in (("step", torch.zeros(())), ("exp_avg", weight), ("exp_avg_sq", weight))
    }


def restore_optimizer(
    optimizer: torch.optim.Optimizer,
    learned: Mapping[str, nn.Parameter],
    tensors: Mapping[str, Tensor],
) -> None:
    """Restore the moments returned by `optimizer_tensors`."""
    numbers = {name: number for number, name in enumerate(learned)}
    moments: dict[int, dict[str, Any]] = {}
    for stored, tensor in part_of(tensors, _OPTIMIZER).items():
        moment, name = stored.split(".", 1)
        moments.setdefault(numbers[name], {})[moment] = tensor
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": moments, "param_groups": groups})


def part_of(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Tensors whose names begin with a prefix, without that prefix."""
    return {n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)}
