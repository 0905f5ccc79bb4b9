"""Scene episodes of a store are what the twin, or a station, recorded."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError
from dextouch.schemas import Review
from services.twin.episodes import record, write_episode
from services.twin.motions import Motion
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.take_options import TakeOptions
from services.world_model.training.episodes import read_episode
from services.world_model.training.scene_episodes import load_scene_episodes

HEAD = ("camera_head",)
LEAN = TakeOptions(images=HEAD, image_every=4, streams="training")
SHOWN = [*range(0, 77, 4), 78, 79, 80]


@pytest.fixture(scope="module")
def truths():
    bottle = Stage("stand_bottle", "robot", TwinSettings())
    bowls = Stage("stack_bowls", "human", TwinSettings())
    lean_push = replace(LEAN, motion=Motion("push", 0))
    takes = {
        "script": record(bottle, 3, replace(LEAN, noise_m=0.005)),
        "push": record(bottle, 4, lean_push),
        "human": record(bowls, 3, LEAN),
        "whole": record(bottle, 5, TakeOptions(images=HEAD, miss=True)),
    }
    unfit = {
        "unknown": {"success": None},
        "recovered": {"recovered": True},
        "imagined": {"origin": "imagined"},
        "station": {"seed": None, "origin": "recorded"},
    }
    for name, changes in unfit.items():
        attributes = takes["push"].attributes.model_copy(update={"episode_id": name, **changes})
        takes[name] = replace(takes["push"], attributes=attributes)
    return takes


@pytest.fixture(scope="module")
def url(truths, tmp_path_factory):
    store = EpisodeStore(tmp_path_factory.mktemp("scenes"))
    for truth in truths.values():
        write_episode(store, truth)
    return str(store.root)


@pytest.fixture(scope="module")
def loaded(truths, url):
    names = {truth.attributes.episode_id: name for name, truth in truths.items()}
    return {names[episode.episode_id]: episode for episode in load_scene_episodes(url)}


def test_only_whole_true_episodes_of_known_outcome_are_taken(loaded, url):
    assert set(loaded) == {"script", "push", "human", "whole", "station"}
    # What a station records is a scene of its own.
    assert (loaded["station"].scene, loaded["station"].seed) == ("stand_bottle/station", None)
    only = load_scene_episodes(url, tasks=["stand_bottle"])
    assert {e.task for e in only} == {"stand_bottle"}


def test_a_store_without_true_episodes_is_refused(truths, tmp_path):
    store = EpisodeStore(tmp_path)
    write_episode(store, truths["imagined"])
    with pytest.raises(InvalidInputError, match=r"none to train on .*origin imagined"):
        load_scene_episodes(str(store.root))


def test_rejected_episodes_are_not_trained_on(truths, tmp_path):
    store = EpisodeStore(tmp_path)
    for name in ("script", "push"):
        write_episode(store, truths[name])
    rejected = truths["push"].attributes.episode_id
    review = Review(verdict="rejected", reviewed_at=datetime(2026, 5, 4, tzinfo=UTC))
    store.set_review(rejected, review)
    (left,) = load_scene_episodes(str(store.root))
    assert left.episode_id == truths["script"].attributes.episode_id


@pytest.mark.parametrize("name", ["script", "push", "human"])
def test_arrays_are_what_the_twin_recorded(truths, loaded, name):
    truth, got = truths[name].streams, loaded[name]
    is_robot = name != "human"
    sent = truth["action_commanded" if is_robot else "action"].values
    assert got.action_kind == ("commanded" if is_robot else "measured")
    np.testing.assert_allclose(got.actions, sent, atol=1e-9)
    np.testing.assert_allclose(got.measured_actions, truth["action"].values, atol=1e-9)
    np.testing.assert_array_equal(got.object_poses, truth["object_poses"].values.astype(np.float32))
    np.testing.assert_array_equal(got.images, truth["camera_head"].values)
    assert got.image_steps.tolist() == SHOWN
    # Four samples of 60 Hz a step; those of step 1 are samples 1 … 4.
    for index, side in enumerate(("left", "right")):
        means = truth[f"tactile_{side}"].values[1:].reshape(80, 4, 320).mean(axis=1)
        np.testing.assert_allclose(got.tactile_kpa[1:, index], means, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", ["script", "push", "human", "whole"])
def test_facts_are_those_of_the_take(truths, loaded, name):
    facts, got = truths[name].attributes, loaded[name]
    assert (got.task, got.seed, got.success) == (facts.task, facts.seed, facts.success)
    assert got.scene == f"{facts.task}/{facts.seed}"
    assert got.object_names == facts.object_names
    np.testing.assert_array_equal(got.object_boxes_m, np.array(facts.object_boxes_m))


def test_streams_at_their_own_rates_are_brought_to_the_grid(truths, loaded):
    truth, got = truths["whole"].streams, loaded["whole"]
    # 30 Hz images: every second one. 100 Hz poses: every 20th is on every third step.
    np.testing.assert_array_equal(got.images, truth["camera_head"].values[::2])
    assert got.image_steps.tolist() == list(range(81))
    poses = truth["object_poses"].values
    np.testing.assert_allclose(got.object_poses[:80:3], poses[:534:20], atol=1e-6)
    # Step 1 is at 66.67 ms, two thirds of the way from sample 6 to sample 7.
    np.testing.assert_allclose(
        got.object_poses[1, :, :3], poses[6, :, :3] / 3 + poses[7, :, :3] * 2 / 3, atol=1e-6
    )


def test_sparse_takes_are_refused_where_every_step_has_to_be_seen(truths, url):
    reader = EpisodeStore(url).open(truths["push"].attributes.episode_id)
    with pytest.raises(InvalidInputError, match="58 of 81 steps have no image"):
        read_episode(reader)
    whole = EpisodeStore(url).open(truths["whole"].attributes.episode_id)
    np.testing.assert_array_equal(
        read_episode(whole).images, truths["whole"].streams["camera_head"].values[::2]
    )
