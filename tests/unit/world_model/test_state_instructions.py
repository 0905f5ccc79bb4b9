"""State models whose tasks share their objects read the instruction."""

import dataclasses

import numpy as np
import pytest
import torch

from services.world_model.checkpoints import write_state_checkpoint
from services.world_model.dynamics.core import RecurrentCore
from services.world_model.dynamics.features import (
    DynamicsConfig,
    TouchCodec,
    instruction_features,
)
from services.world_model.settings import CoreLossWeights, CoreSettings, StateTrainSettings
from services.world_model.state_world import StateWorld
from services.world_model.training.member_training import CoreData, touch_latents, train_core
from services.world_model.training.scene_table import scene_table
from services.world_model.training.state_data import StateData, configured
from services.world_model.training.transfer import Base
from tests.contracts.test_world import from_observation, untrained_state_checkpoint
from tests.unit.world_model.test_dynamics import random_commands, start
from tests.unit.world_model.test_state_training import PX, episode

SENTENCES = ("press the block", "leave the block alone")
READS = DynamicsConfig(
    tasks=("press",), num_objects=(1,), image_px=PX, width=32, touch_channels=8,
    instructions=SENTENCES,
)  # fmt: skip


def instructed(seed, sentence, *, success, **changes):
    """The toy episode of a seed, with this instruction and outcome."""
    one = episode(seed)
    about = {"instruction": sentence, "success": success, **changes}
    return dataclasses.replace(one, about=one.about.model_copy(update=about))


def base_at(folder, instructions=()):
    one = untrained_state_checkpoint(instructions)
    path = folder / "base.safetensors"
    write_state_checkpoint(path, one.dynamics, one.renderer, one.metadata)
    return Base(path)


def test_features_are_alike_as_sentences_share_words():
    same, other, reordered, empty = instruction_features(
        ["Press the block.", SENTENCES[1], "the block: press", ""], READS
    )
    known = instruction_features(SENTENCES, READS)
    assert known.shape == (2, READS.instruction_size)
    torch.testing.assert_close(same, known[0])
    torch.testing.assert_close(known[0], reordered)
    torch.testing.assert_close(known.square().mean(1), torch.ones(2))
    assert 0.2 < float(known[0] @ other) / READS.instruction_size < 0.8
    assert not empty.any()
    silent = READS.model_copy(update={"instructions": ()})
    assert instruction_features(SENTENCES, silent).shape == (2, 0)
    assert "instructions" not in silent.model_dump_json()


def test_the_same_motion_succeeds_by_one_sentence_and_fails_by_the_other():
    """All episodes have the same objects, commands and touch; the sentence alone decides."""
    pairs = [(seed, index) for seed in range(6) for index in (0, 1)]
    episodes = [instructed(seed, SENTENCES[index], success=index == 0) for seed, index in pairs]
    estimates = {}
    for config in (READS, READS.model_copy(update={"instructions": ()})):
        table = scene_table(episodes, config)
        data = CoreData(table, touch_latents(TouchCodec(config.touch_channels), table), {})
        settings = CoreSettings(
            num_steps=150, batch=8, first_fraction=1.0, held_fraction=0.0,
            weights=CoreLossWeights(objects=0, touch=0, contact=0, taxels=0),
        )  # fmt: skip
        core = train_core(data, config, settings, seed=0).eval()
        rows = torch.arange(2)
        commands = table.commands(rows, 0, torch.zeros(2, dtype=torch.bool))
        begun = dataclasses.replace(
            start(2), objects=table.objects_at(rows, 0), task=table.task[rows],
            touch=torch.zeros(2, 2, 8), pads_kpa=table.pads_kpa[rows, 0],
            instruction=table.instruction[rows], sd_m=torch.zeros(2, 3), size=torch.ones(2, 3, 2),
        )  # fmt: skip
        with torch.no_grad():
            future, _ = core(commands, begun, core.first_state(begun, commands[:1]))
        estimates[bool(config.instructions)] = future.success[:, -1].sigmoid().numpy()
    assert estimates[True][0] > 0.8
    assert estimates[True][1] < 0.2
    np.testing.assert_allclose(*estimates[False], atol=1e-6)


@pytest.mark.parametrize(
    ("others", "reads"),
    [
        ({}, False),
        ({"instruction": SENTENCES[1]}, True),
        ({"task": "leave", "instruction": SENTENCES[1]}, True),
        ({"task": "leave", "instruction": SENTENCES[1], "object_names": ("cup",)}, False),
    ],
)
def test_instructions_are_read_where_the_scene_does_not_say_what_to_do(others, reads, tmp_path):
    episodes = [instructed(0, SENTENCES[0], success=True)]
    about = {"instruction": SENTENCES[0], **others}
    episodes.append(instructed(1, about.pop("instruction"), success=True, **about))
    data = StateData(episodes, episodes)
    settings = StateTrainSettings(episodes=("takes",))
    expected = SENTENCES if reads else ()
    assert sorted(configured(data, settings).instructions) == sorted(expected)
    # Kept cores cannot learn to read; those that do keep reading.
    silent = base_at(tmp_path)
    kept = settings.model_copy(update={"learn": "readers"})
    assert configured(data, kept, silent).instructions == ()
    sentences = {one.about.instruction for one in episodes}
    reading = base_at(tmp_path, ("stand the bottle up",))
    assert set(configured(data, kept, reading).instructions) == sentences


@torch.no_grad()
@pytest.mark.parametrize("own", [(), ("stand the bottle up",)])
def test_a_core_that_learns_to_read_or_of_people_begins_as_it_was(own, tmp_path):
    base = base_at(tmp_path, own)
    config = base.checkpoint.metadata.dynamics
    wider = config.model_copy(
        update={"domains": ("robot", "human"), "instructions": (*own, "lay the bottle down")}
    )
    before = base.core(config, 1, seed=0, learns_all=True).eval()
    after = base.core(wider, 1, seed=0, learns_all=True).eval()
    commands = random_commands(1, 3)

    def said(core: RecurrentCore, sentence: str):
        begun = dataclasses.replace(
            start(1), task=torch.zeros(1, dtype=torch.int64), touch=torch.ones(1, 2, 96),
            instruction=instruction_features([sentence], core.config),
        )  # fmt: skip
        return core(commands, begun, core.first_state(begun, commands[:1]))[0].success

    for sentence in ("stand the bottle up", "lay the bottle down"):
        torch.testing.assert_close(said(after, sentence), said(before, sentence))
    if own:
        assert not torch.equal(said(after, "stand it up"), said(after, "lay it down"))


def test_a_world_says_which_instructions_it_does_not_know():
    world = StateWorld(untrained_state_checkpoint(("stand the bottle up", "lay the bottle down")))

    def reason(sentence):
        request = dataclasses.replace(from_observation(world), instruction=sentence)
        started = world.reset(request)
        still = np.repeat(started.observation.action_reached[-1:], 4, axis=0)
        state = world.restore(world.snapshot(started.state))
        stepped = world.step(state, still, seed=0)
        return stepped.observation.uncertainty.reason or ""

    assert "instruction" not in reason("Stand the bottle up!")
    assert "instruction is none of training" in reason("throw the bottle away")
