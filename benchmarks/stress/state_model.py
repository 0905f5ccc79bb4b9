"""Stress of the state model, opened through `open_world`.

A small model with random weights stands in for a trained one: the checks must hold for any weights.
"""

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

from benchmarks.stress import worlds
from benchmarks.stress.cells import Check, StageCells
from benchmarks.stress.worlds import TASK, Subject
from dextouch.errors import EndedError, InvalidInputError
from services.world_model.checkpoints import (
    StateMetadata,
    read_state_checkpoint,
    write_state_checkpoint,
)
from services.world_model.dynamics.features import DynamicsConfig
from services.world_model.dynamics.model import DynamicsModel
from services.world_model.network.configuration import RendererConfig
from services.world_model.rendering.renderer import RendererNetwork
from services.world_model.state_world import StateWorld
from services.world_model.world import open_world

STAGE = StageCells("state-model")
_PX = 32
_TRAINED_KPA = 10.0


@STAGE.cell("ends", "chunks of 4 and 64 steps and beyond")
def _ends(check: Check) -> None:
    worlds.check_chunk_ends(check, _subject())


@STAGE.cell(
    "precision", "weights in bfloat16, float16 and float64; sampling steps, which it has none"
)
def _precision(check: Check) -> None:
    subject = _subject()
    for dtype in (torch.bfloat16, torch.float16, torch.float64):
        with tempfile.TemporaryDirectory() as folder:
            found = read_state_checkpoint(_written(Path(folder)))
        checkpoint = replace(found, dynamics=found.dynamics.to(dtype))
        check.refused(
            f"weights {dtype}",
            lambda c=checkpoint: Subject(StateWorld(c), subject.begun).step(subject.still()),
            kind=InvalidInputError,
        )


@STAGE.cell("long_run", "hands that stand still for 63 chunks; hands that move until it refuses")
def _long_run(check: Check) -> None:
    subject = _subject()
    poses = subject.world.reset(subject.touching(0.0)).observation.object_poses
    seen = worlds.stand_still(subject)
    peak_kpa = worlds.peak_kpa(seen)
    check.at_most("peak of still hands, of random weights", peak_kpa, _TRAINED_KPA, "kPa")
    last = seen[-1].object_poses
    check.true("it gives object poses", poses is not None and last is not None)
    if poses is not None and last is not None:
        moved_m = np.abs(last[-1, :, :3] - poses[-1, :, :3]).max()
        check.at_most("objects beside still hands move", moved_m, 1e-6, "m")
    check.refused("hands that move for ever", _play, check, subject, kind=EndedError)


STAGE.does_not_apply(
    one_axis="nothing is estimated from motion; see hand-eye",
    clock="steps are counted, there is no clock; see clocks",
    device="it is loaded on the CPU, and nothing takes a device",
)


def _play(check: Check, subject: Subject) -> None:
    state = subject.world.reset(subject.begun.start).state
    for stepped in worlds.play(subject.world, state, worlds.there_and_back(subject.actions)):
        check.finite("touch of moving hands", stepped.observation.tactile_kpa)
        trusted = stepped.observation.uncertainty is not None
        check.true("every answer says how far it is trusted", trusted)


@cache
def _subject() -> Subject:
    with tempfile.TemporaryDirectory() as folder:
        return Subject(open_world(_written(Path(folder))), worlds.demonstration(_PX))


def _written(folder: Path) -> Path:
    """Write a small state model with random weights to a file."""
    generator = torch.Generator().manual_seed(0)
    config = DynamicsConfig(tasks=(TASK,), num_objects=(1,), image_px=_PX, width=16)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        dynamics = DynamicsModel(config, num_members=2)
        shape = RendererConfig(widths=(8, 8), depths=(1, 1))
        renderer = RendererNetwork(shape)
    dynamics.codec.fit(_TRAINED_KPA * torch.rand(272, 320, generator=generator))
    metadata = StateMetadata(
        name="untrained",
        dynamics=config,
        num_members=2,
        renderer=shape,
        object_names={TASK: ("bottle",)},
        object_boxes_m={TASK: ((0.0, 0.0, 0.0, 0.03, 0.03, 0.1),)},
        command="python -m benchmarks stress",
        seed=0,
        training_cpu_s=0.0,
        num_training_episodes=0,
        training_seeds={},
        data_hash="0",
    )
    path = folder / "untrained.safetensors"
    write_state_checkpoint(path, dynamics, renderer, metadata)
    return path


worlds.add_shared_cells(STAGE, _subject, lambda: _TRAINED_KPA)
