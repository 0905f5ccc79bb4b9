"""A state model that a training starts from, and its parts as a training continues them."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from dextouch.errors import InvalidInputError
from dextouch.tactile.layout import common_layout
from services.world_model.checkpoints import read_state_checkpoint
from services.world_model.dynamics.core import RecurrentCore, direction_free_inputs
from services.world_model.dynamics.features import DynamicsConfig
from services.world_model.dynamics.start_reader import StartReader

# Tensors of a reader or a core with a row for every task.
_OF_TASKS = {"task.weight", "height_mean", "boxes_m", "movable"}
# Weights of a core that predict success.
_SUCCESS = "success."


class Base:
    """A state model that another one starts from; raises as `read_state_checkpoint`."""

    def __init__(self, path: Path) -> None:
        self._path, self.checkpoint = path, read_state_checkpoint(path)

    def configured(self, config: DynamicsConfig, *, keeps_tasks: bool) -> DynamicsConfig:
        """A configuration with the shape of the base's networks, for another's tasks, or its own.

        Raises:
            InvalidInputError: images of another size, or another glove.
        """
        own = self.checkpoint.metadata.dynamics
        common_layout(
            [own.tactile_layout, config.tactile_layout],
            what=f"--init {self._path.name} and the episodes",
        )
        if own.image_px != config.image_px:
            raise InvalidInputError(
                f"--init {self._path.name}: reads images of {own.image_px} px, the episodes have "
                f"{config.image_px} px; give --image-px {own.image_px}, and images no smaller"
            )
        if keeps_tasks:
            return own
        of_data = {
            "tasks": config.tasks,
            "num_objects": config.num_objects,
            "domains": own.domains if own.has_humans else config.domains,
            "instructions": config.instructions,
        }
        return own.model_copy(update=of_data)

    def has_tasks_of(self, config: DynamicsConfig) -> bool:
        """Whether the base has all of these tasks, with as many objects."""
        own = self.checkpoint.metadata.dynamics
        counts = set(zip(own.tasks, own.num_objects, strict=True))
        return counts >= set(zip(config.tasks, config.num_objects, strict=True))

    def _own(self, member: int) -> int:
        """Member of the base that a member starts from: more members share those of the base."""
        return member % self.checkpoint.metadata.num_members

    def reader(self, config: DynamicsConfig, member: int, *, seed: int) -> StartReader:
        """A member's reader; weights of tasks that the base does not know are fresh."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            reader = StartReader(config)
        known = self.checkpoint.dynamics.readers()[self._own(member)].state_dict()
        kept = {name: value for name, value in known.items() if name not in _OF_TASKS}
        reader.load_state_dict(kept, strict=False)
        self._copy_tasks(config, reader.state_dict(), known)
        return reader

    @torch.no_grad()
    def _copy_tasks(
        self, config: DynamicsConfig, to: Mapping[str, Tensor], known: Mapping[str, Tensor]
    ) -> None:
        """Copy the rows of tasks that the base knows, of tensors with a row for every task."""
        own = self.checkpoint.metadata.dynamics.tasks
        for name in _OF_TASKS & to.keys():
            for row, task in enumerate(config.tasks):
                if task in own:
                    to[name][row].copy_(known[name][own.index(task)])

    def core(
        self, config: DynamicsConfig, member: int, *, seed: int, learns_all: bool
    ) -> RecurrentCore:
        """A member's core, in which all can be trained, or only fresh weights that predict success.

        Of new tasks, these see distances, heights and angles alone, for want of takes.
        """
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            core = RecurrentCore(config)
        known, own = self.checkpoint.dynamics.core, self._own(member)
        kept = {
            name: value[own : own + 1]
            for name, value in known.named_parameters()
            if learns_all or not name.startswith(_SUCCESS)
        }
        core.load_state_dict(_with_new_inputs(kept, known.config, core), strict=False)
        self._copy_tasks(config, core.state_dict(), known.state_dict())
        core.lowest.copy_(known.lowest)
        core.highest.copy_(known.highest)
        if learns_all:
            return core
        core.requires_grad_(requires_grad=False)
        core.success.requires_grad_(requires_grad=True)
        if self.has_tasks_of(config):
            return core
        first = core.get_parameter(f"{_SUCCESS}0.weight")
        used = torch.zeros(1, first.shape[1], 1)
        used[:, direction_free_inputs(config.width)] = 1.0
        with torch.no_grad():
            first.mul_(used)
        first.register_hook(lambda gradient: gradient * used)  # type: ignore[no-untyped-call]
        return core


def _with_new_inputs(
    kept: dict[str, Tensor], own: DynamicsConfig, core: RecurrentCore
) -> dict[str, Tensor]:
    """Weights for a core with new inputs (people, an instruction), without effect at first."""
    shapes = {name: value.shape for name, value in core.named_parameters()}
    known = dict(kept)
    new_sentence = core.config.instruction_size - own.instruction_size
    for name, value in kept.items():
        missing = shapes[name][1] - value.shape[1] if value.ndim == 3 else 0
        if missing:
            others = value.shape[1] - own.instruction_size
            before = functional.pad(value[:, :others], (0, 0, 0, missing - new_sentence))
            both = torch.cat([before, value[:, others:]], dim=1)
            known[name] = functional.pad(both, (0, 0, 0, new_sentence))
    for name in shapes:
        robots = name.removeprefix("human.")
        if name not in kept and robots in kept:
            known[name] = kept[robots]
    return known
