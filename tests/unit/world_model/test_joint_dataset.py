"""Windows cut from memory are the reader's windows; the split and the hash know the content."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError
from services.world_model.training.joint_dataset import (
    WindowPosition,
    WindowSampler,
    index_episodes,
    load_episodes,
    read_episode,
)
from tests.unit.evaluation import toy
from tests.unit.evaluation import toy_store as toy_store_of_takes
from tests.unit.world_model.conftest import make_episode


@pytest.mark.parametrize("kind", ["measured", "commanded"])
@pytest.mark.parametrize(("start", "num_steps"), [(0, 17), (7, 9), (24, 17)])
def test_a_cut_window_is_the_readers_window(toy_store, kind, start, num_steps):
    reader = toy_store.open("toy-2")
    cut = read_episode(reader).cut(WindowPosition(0, start, num_steps, action_kind=kind))
    read = reader.window(start, num_steps, action_kind=kind)
    np.testing.assert_array_equal(cut.images, read.images["camera_head"])
    np.testing.assert_array_equal(cut.tactile_kpa, read.tactile_kpa)
    np.testing.assert_array_equal(cut.tactile_valid, read.tactile_valid)
    np.testing.assert_allclose(cut.request.actions, read.actions, atol=1e-12)
    for ours, theirs in zip(cut.request.anchor.as_tuple(), read.anchor.as_tuple(), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)
    assert cut.request.instruction == read.instruction


def test_a_chained_window_starts_where_the_command_was(toy_episode):
    episode = toy_episode(1)
    cut = episode.cut(WindowPosition(0, 6, 9, action_kind="commanded", from_command=True))
    np.testing.assert_allclose(cut.request.actions[0, :3], 0, atol=1e-12)
    plain = episode.cut(WindowPosition(0, 6, 9, action_kind="commanded"))
    gap_m = np.linalg.norm(
        cut.request.anchor.T_world_wrist_left[:3, 3]
        - plain.request.anchor.T_world_wrist_left[:3, 3]
    )
    assert gap_m > 1e-3
    # Both describe the same absolute path.
    ends = [
        (w.request.anchor.T_world_wrist_left @ np.append(w.request.actions[-1, :3], 1.0))[:3]
        for w in (cut, plain)
    ]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)


def test_the_sampler_repeats_itself_and_mixes_kinds(toy_episodes):
    def draw():
        return WindowSampler(toy_episodes, np.random.default_rng(4), max_steps=17).draw(24, 9)

    a, b = draw(), draw()
    assert torch.equal(a.images, b.images)
    kinds = {request.action_kind for request in a.requests}
    assert kinds == {"measured", "commanded"}
    assert a.images.shape == (24, 9, 32, 32, 3)


def test_episodes_without_commands_still_train(toy_episodes):
    human = [replace(e, actions={"measured": e.actions["measured"]}) for e in toy_episodes]
    batch = WindowSampler(human, np.random.default_rng(0), max_steps=17).draw(8, 5)
    assert {request.action_kind for request in batch.requests} == {"measured"}


def test_too_short_episodes_and_none_are_refused(toy_episode):
    with pytest.raises(InvalidInputError, match="no 17 measured steps in a row"):
        WindowSampler([toy_episode(0, 12)], np.random.default_rng(0), max_steps=17)
    with pytest.raises(InvalidInputError, match="got 0"):
        WindowSampler([], np.random.default_rng(0), max_steps=17)


def test_the_fingerprint_is_of_the_content_not_the_name(toy_episode):
    episode = toy_episode(0)
    assert (
        replace(episode, episode_id="other", scene="push_box/99").fingerprint()
        == episode.fingerprint()
    )
    touched = episode.tactile_kpa.copy()
    touched[3, 1, 7] += 1e-3
    assert replace(episode, tactile_kpa=touched).fingerprint() != episode.fingerprint()


def test_a_store_is_loaded_whole(toy_store, toy_episodes):
    loaded = load_episodes(str(toy_store.root))
    assert [e.episode_id for e in loaded] == [e.episode_id for e in toy_episodes]
    assert loaded[2].fingerprint() == toy_episodes[2].fingerprint()


@pytest.mark.parametrize("read", [load_episodes, index_episodes])
def test_episodes_with_smaller_images_are_left_out(read, tmp_path):
    store, item = EpisodeStore(tmp_path), toy.demonstration("reach", 1)
    toy_store_of_takes.write(store, item)
    small = replace(item, episode_id="small", images=item.images[:, :24])
    toy_store_of_takes.write(store, small)
    found = read(str(store.root), image_px=toy.SIZE)
    assert [one.episode_id for one in found] == [item.episode_id]


def test_every_start_is_drawn_the_last_one_too(toy_episode):
    sampler = WindowSampler([toy_episode(0, 19)], np.random.default_rng(0), max_steps=17)
    assert {place.start for place in sampler.places(60, 17)} == {0, 1, 2}


def test_a_window_carries_the_flags_of_its_own_steps(toy_episode):
    episode = toy_episode(0)
    episode.tactile_valid[7, 1] = False
    flags = episode.cut(WindowPosition(0, 5, 9)).tactile_valid
    assert np.argwhere(~flags).tolist() == [[2, 1]]


def test_other_actions_are_another_fingerprint(toy_episode):
    episode = toy_episode(0)
    before = episode.fingerprint()
    episode.actions["measured"][3, 20] += 0.01
    assert episode.fingerprint() != before


def test_refused_taxels_never_reach_a_window():
    clean, refused = make_episode(0), np.zeros((2, 320), dtype=bool)
    refused[0, ::3] = True
    # The whole left index finger, and most of the right hand.
    refused[0, 16:32], refused[1, 100:] = True, True
    noise = np.random.default_rng(1).uniform(0, 500, clean.tactile_kpa.shape).astype(np.float32)
    windows = []
    for value in (clean.tactile_kpa, noise):
        touch = np.where(refused, value, clean.tactile_kpa)
        episode = replace(clean, tactile_kpa=touch, measured_taxels=~refused)
        windows.append(episode.cut(WindowPosition(3, 0, 9)))
    one, other = windows
    np.testing.assert_array_equal(one.tactile_kpa, other.tactile_kpa)
    np.testing.assert_array_equal(one.request.first_tactile_kpa, other.request.first_tactile_kpa)
    np.testing.assert_array_equal(
        one.tactile_kpa[:, ~refused], clean.tactile_kpa[3:12][:, ~refused]
    )
    assert (one.tactile_kpa[:, 0, 16:32] == 0).all()
    assert one.tactile_valid.all(axis=0).tolist() == [True, False]
