"""Where the state of a training run is kept: one file, or under torchrun a folder of shards.

The folder has a folder for each state, with a safetensors file of every process. The counters, in a
JSON file beside them, name the newest complete one, so that a crash at any time leaves it. Any
number of processes can resume.
"""

import os
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import torch
from pydantic import JsonValue
from torch import Tensor, distributed
from torch.distributed.checkpoint.hf_storage import (
    HuggingFaceStorageReader,
    HuggingFaceStorageWriter,
)
from torch.distributed.checkpoint.state_dict_loader import load
from torch.distributed.checkpoint.state_dict_saver import save

from dextouch.errors import ConflictError, CorruptDataError
from services.world_model.training.distribution import Processes
from services.world_model.training.training_state import (
    TrainingState,
    checked_facts,
    read_state,
    state_path,
    write_state,
)

FACTS: Final = "newest.json"


class StateFiles:
    """State of the run with this output; all its processes must call each method.

    Args:
        output: checkpoint that the run will write.
        processes: processes of the run.
    """

    def __init__(self, output: Path, processes: Processes) -> None:
        self._file = state_path(output)
        self._folder = self._file.with_name(self._file.name + ".shards")
        self._processes = processes
        self._is_sharded = processes.mesh is not None

    def exists(self) -> bool:
        """Whether there is a state to resume.

        Raises:
            ConflictError: there is only one of a run that was started otherwise.
        """
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
        """Read the state of a run with these settings and data.

        Args:
            identity: from `identity_of`.
            own: a tensor of the same name, shape and sharding for every tensor of the state.

        Raises:
            ConflictError: the state has other settings or data; they are named.
            CorruptDataError: not a training state, or a damaged one.
        """
        if not self._is_sharded:
            return read_state(self._file, identity)
        where = f"training state {self._folder.name}"
        facts = checked_facts((self._folder / FACTS).read_text(), identity, where)
        reader = HuggingFaceStorageReader(str(self._of_step(facts.step)))
        stored = reader.read_metadata().state_dict_metadata
        if not stored or stored.keys() - own.keys():
            raise CorruptDataError(f"{where}: incomplete; remove it to start over")
        tensors = {name: torch.zeros_like(own[name]) for name in stored}
        load(tensors, storage_reader=reader)
        return TrainingState(tensors, facts)

    def write(self, state: TrainingState) -> None:
        """Replace the state."""
        if not self._is_sharded:
            write_state(self._file, state)
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
