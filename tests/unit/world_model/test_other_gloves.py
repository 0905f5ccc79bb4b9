"""World models of a glove of 138 taxels: sizes follow its layout, and others are refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dextouch.episodes import EpisodeGrid, EpisodeStore
from dextouch.errors import InvalidInputError, ShapeError
from dextouch.schemas import RolloutStart
from dextouch.tactile import DEXTOUCH_V1, TactileLayout
from services.world_model.checkpoints import (
    read_checkpoint,
    read_state_checkpoint,
    read_tokenizer,
)
from services.world_model.dynamics.features import DynamicsConfig, TouchCodec
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.tactile import build_tokenizer, canvas_cells
from services.world_model.paper_settings import TrainTokenizerSettings
from services.world_model.settings import CoreSettings, ReaderSettings, StateTrainSettings
from services.world_model.training.joint_trainer import train_on
from services.world_model.training.state_data import StateData, configured, load_scene_episodes
from services.world_model.training.state_trainer import train_state
from services.world_model.training.tokenizer_trainer import train_tokenizer
from services.world_model.world import open_world
from tests.unit.other_gloves import small_layout
from tests.unit.world_model.conftest import make_episode, write_episode

LAYOUT = small_layout()


def small_episode(seed, layout=LAYOUT):
    """A toy episode of the small glove."""
    episode = make_episode(seed)
    return replace(
        episode,
        tactile_kpa=np.ascontiguousarray(episode.tactile_kpa[:, :, -138:]),
        measured_taxels=np.ones((2, 138), dtype=bool),
        tactile_layout=layout,
    )


@pytest.fixture(scope="module")
def small_store(tmp_path_factory):
    store = EpisodeStore(tmp_path_factory.mktemp("small") / "store")
    for seed in range(6):
        write_episode(store, small_episode(seed), success=seed % 2 == 0)
    return store


def start_of(store, *, taxels=138):
    grid_window = store.open("toy-0").window(0, 1)
    observation = EpisodeGrid(store.open("toy-0")).observation()
    touch = np.zeros((1, 2, taxels), np.float32)
    touch[..., : grid_window.tactile_kpa.shape[-1]] = grid_window.tactile_kpa[..., :taxels]
    return RolloutStart(
        "push_box",
        0,
        "push the box with both hands",
        observation=replace(observation, tactile_kpa=touch),
        anchor=grid_window.anchor,
        K_head=grid_window.K_head,
    )


def check_world(path, store):
    """A rollout of the small glove; a start of another one is refused by name."""
    world = open_world(path)
    assert world.description.tactile_layout == LAYOUT
    assert world.description.num_taxels == 138
    started = world.reset(start_of(store))
    actions = np.repeat(started.observation.action_reached, 4, axis=0)
    stepped = world.step(started.state, actions, seed=0)
    assert stepped.observation.tactile_kpa.shape == (4, 2, 138)
    again = world.restore(world.snapshot(stepped.state))
    np.testing.assert_array_equal(
        world.step(again, actions, seed=0).observation.tactile_kpa,
        world.step(stepped.state, actions, seed=0).observation.tactile_kpa,
    )
    with pytest.raises(ShapeError, match=r"got touch of 320 taxels, expected 138.*'small'"):
        world.reset(start_of(store, taxels=320))


@pytest.mark.parametrize("name", ["principal_axes", "split_hands", "grid"])
def test_a_tokenizer_is_trained_and_read_back(name, small_store, tmp_path):
    settings = TrainTokenizerSettings(
        episodes=(str(small_store.root),),
        output=tmp_path / "tokenizer.safetensors",
        tokenizer=name,
        max_steps=2,
        num_evaluations=1,
        heldout_share=0.15,
        palm_channels=24,
        tactile_channels=48,
        optimizer={"batch": 8},
    )
    train_tokenizer(settings)
    stored = read_tokenizer(settings.output)
    assert stored.metadata.layout == LAYOUT
    touch = torch.from_numpy(small_episode(0).tactile_kpa[:, 0])
    decoded = stored.tokenizer.decode(stored.tokenizer.encode(touch))
    assert decoded.shape == (41, 138)
    assert float(stored.tokenizer.decode(stored.tokenizer.encode(0 * touch)).abs().max()) == 0
    if name == "principal_axes":
        # The toy's touch has one pattern: its axes hold it but for half precision.
        torch.testing.assert_close(decoded, touch, atol=0.05, rtol=0.01)


def test_the_grid_has_a_cell_for_every_taxel():
    cells, (rows, columns) = canvas_cells(LAYOUT)
    # 3 rows of tips above 7 of the palm, 5 × 5 columns; both filled up to multiples of four.
    assert (rows, columns) == (12, 28)
    assert len(set(cells.tolist())) == 138
    # The thumb's second row, and the palm's first taxel below the tips in the middle of 25.
    assert cells[5:10].tolist() == [28, 29, 30, 31, 32]
    assert cells[75] == 3 * 28 + 8


def test_episodes_of_two_gloves_are_refused(small_store, tmp_path, train_settings):
    store = EpisodeStore(tmp_path / "mixed")
    for seed in range(4):
        one = small_episode(seed) if seed % 2 else make_episode(seed)
        write_episode(store, one, success=True)
    settings = TrainTokenizerSettings(
        episodes=(str(store.root),), output=tmp_path / "t", tokenizer="principal_axes"
    )
    found = r"got tactile layouts '(small|dextouch_v1)'.*'(small|dextouch_v1)'.*expected one layout"
    with pytest.raises(InvalidInputError, match=found):
        train_tokenizer(settings.model_copy(update={"heldout_share": 0.5}))
    episodes = [make_episode(0), small_episode(1)]
    with pytest.raises(InvalidInputError, match=found):
        train_on(episodes, [small_episode(2)], train_settings)
    state = StateTrainSettings(episodes=(str(store.root),), image_px=32, heldout_share=0.3)
    with pytest.raises(InvalidInputError, match=found):
        train_state(state.model_copy(update={"output": tmp_path / "s.safetensors"}))


def test_the_joint_model_is_trained_for_the_glove(small_store, train_settings, tmp_path):
    episodes = [small_episode(seed) for seed in range(3)]
    settings = train_settings.model_copy(update={"episodes": str(small_store.root), "max_steps": 2})
    report = train_on(episodes[:2], episodes[2:], settings)
    checkpoint = read_checkpoint(report.checkpoint)
    assert checkpoint.metadata.network.tactile_layout == LAYOUT
    assert checkpoint.model.tokenizer.palm_basis.shape == (63, 8)
    check_world(report.checkpoint, small_store)
    # Another glove cannot go on from these weights.
    again = settings.model_copy(update={"init": report.checkpoint, "max_steps": 3})
    with pytest.raises(InvalidInputError, match="--init and the training episodes: got tactile"):
        train_on([make_episode(7), make_episode(8)], [make_episode(9)], again)


def test_the_state_model_is_trained_for_the_glove(small_store, tmp_path):
    output = tmp_path / "state.safetensors"
    train_state(
        StateTrainSettings(
            episodes=(str(small_store.root),),
            output=output,
            image_px=32,
            heldout_share=0.3,
            num_members=1,
            width=16,
            jobs=1,
            reader=ReaderSettings(num_steps=2, batch=4, bfloat16=False),
            core=CoreSettings(num_steps=2, batch=4),
            drawing={"max_steps": 1},
        )
    )
    checkpoint = read_state_checkpoint(output)
    assert checkpoint.metadata.dynamics.layout == LAYOUT
    assert checkpoint.dynamics.codec.basis.shape == (138, 96)
    check_world(output, small_store)


def test_files_of_the_usual_glove_name_no_layout(checkpoint, train_settings):
    assert "layout" not in checkpoint.metadata.model_dump_json()
    config = DynamicsConfig(tasks=("a",), num_objects=(1,))
    assert "layout" not in config.model_dump_json()
    assert NetworkConfig().with_layout(DEXTOUCH_V1).model_dump() == NetworkConfig().model_dump()


def test_sizes_beyond_the_glove_are_refused():
    with pytest.raises(ValueError, match="touch_channels: got 139, expected at most 138"):
        DynamicsConfig(tasks=("a",), num_objects=(1,), touch_channels=139, layout=LAYOUT)
    with pytest.raises(InvalidInputError, match=r"palm_channels 64.*'small', expected at most 63"):
        build_tokenizer(NetworkConfig(palm_channels=64).with_layout(LAYOUT))
    with pytest.raises(InvalidInputError, match="split_hands: got layout 'small' with pads"):
        build_tokenizer(
            NetworkConfig(tokenizer="split_hands").with_layout(part_of_layout(slice(5)))
        )


def part_of_layout(pads):
    """The small glove with some of its pads."""
    plain = LAYOUT.model_dump()
    kept = plain["pads"][pads]
    num_taxels = sum(pad["rows"] * pad["columns"] for pad in kept)
    cells = {side: indices[:num_taxels] for side, indices in plain["raw_cells"].items()}
    return TactileLayout.model_validate(plain | {"pads": kept, "raw_cells": cells})


def test_principal_axes_hold_a_palm_alone():
    layout = part_of_layout(slice(5, 6))
    tokenizer = build_tokenizer(NetworkConfig(palm_channels=63).with_layout(layout))
    touch = 50 * torch.rand(40, 2, 63, generator=torch.Generator().manual_seed(0))
    tokenizer.fit(touch)
    assert all(torch.isfinite(buffer).all() for buffer in tokenizer.buffers())
    decoded = tokenizer.decode(tokenizer.encode(touch))
    torch.testing.assert_close(decoded, touch, atol=1e-3, rtol=0)


def test_fingertips_alone_need_the_tokenizer_that_the_error_names():
    layout = part_of_layout(slice(5))
    with pytest.raises(InvalidInputError, match=r"expected at most 0.*palm; train.*grid`$"):
        build_tokenizer(NetworkConfig().with_layout(layout))
    tokenizer = build_tokenizer(NetworkConfig(tokenizer="grid").with_layout(layout))
    touch = torch.ones(2, 75)
    tokenizer.fit(touch.expand(4, 2, 75))
    assert tokenizer.decode(tokenizer.encode(touch)).shape == (2, 75)


@pytest.mark.parametrize("num_taxels", [1, 3])
def test_a_state_model_may_have_a_glove_of_few_taxels(num_taxels, tmp_path):
    plain = LAYOUT.model_dump()
    pad = plain["pads"][0] | {"rows": 1, "columns": num_taxels}
    cells = {side: indices[:num_taxels] for side, indices in plain["raw_cells"].items()}
    layout = TactileLayout.model_validate(plain | {"pads": [pad], "raw_cells": cells})
    episode, store = make_episode(0), EpisodeStore(tmp_path)
    touch_kpa = np.ascontiguousarray(episode.tactile_kpa[:, :, -num_taxels:])
    measured = np.ones((2, num_taxels), dtype=bool)
    few = replace(episode, tactile_kpa=touch_kpa, measured_taxels=measured, tactile_layout=layout)
    write_episode(store, few, success=True)
    (grid,) = load_scene_episodes(str(tmp_path))
    config = configured(StateData([grid], [grid]), StateTrainSettings(episodes=("none",)))
    codec = TouchCodec(config.touch_channels, num_taxels)
    touch = torch.rand(20, num_taxels, generator=torch.Generator().manual_seed(0))
    codec.fit(touch)
    torch.testing.assert_close(codec.decode(codec.encode(touch)), touch)
