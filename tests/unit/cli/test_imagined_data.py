"""Which episodes `dextouch train imagined` takes, and that it draws all that a judge looks at."""

import argparse
import json

import numpy as np
import pytest

from dextouch.clients import RolloutClient
from dextouch.command_line import positive
from dextouch.episodes import EpisodeStore
from dextouch.errors import EndedError, NotFoundError
from dextouch.schemas import EVERYTHING, LineageEntry
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.evaluation.endings import read_ending_episode
from services.generation import imagine_episode
from services.pipelines import imagined_data
from services.pipelines.imagined_data import (
    WORLD,
    _picture,
    chosen_episodes,
    imagined_main,
    judged_steps,
    refuse_trained_episodes,
)
from services.pipelines.parsers import seed_range
from services.pipelines.servers import served
from services.twin.episodes import TakeOptions, record, write_episode
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.world_model.checkpoints import (
    CheckpointMetadata,
    write_checkpoint,
    write_state_checkpoint,
)
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.model import JointWorldModel
from services.world_model.state_world import StateWorld
from services.world_model.world import open_world
from tests.contracts.test_world import untrained_state_checkpoint
from tests.unit.evaluation import toy, toy_store


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    """A store of one episode whose scene is shown to a judge at steps 8 and 64."""
    store = EpisodeStore(tmp_path_factory.mktemp("truth"))
    stage = Stage("stand_bottle", "robot", TwinSettings(image_height_px=32, image_width_px=32))
    write_episode(store, record(stage, 4, TakeOptions(images=("camera_head",))))
    return store


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "untrained.safetensors"
    loaded = untrained_state_checkpoint()
    write_state_checkpoint(path, loaded.dynamics, loaded.renderer, loaded.metadata)
    return path


class EndingWorld(toy.ToyWorld):
    """Cannot continue the rollout of one seed."""

    def step(self, state, actions, *, seed, selector=EVERYTHING):
        if state.step >= 48 and np.array_equal(state.target, toy.target_m("reach", 2)):
            raise EndedError("dream: lost", reason="hands moved too long")
        return super().step(state, actions, seed=seed, selector=selector)


def test_an_episode_that_a_world_cannot_finish_does_not_keep_the_others_back(
    tmp_path, monkeypatch, capsys
):
    store, target = EpisodeStore(tmp_path / "true"), tmp_path / "imagined"
    for seed in (1, 2, 3):
        toy_store.write(store, toy.demonstration("reach", seed))
    world = EndingWorld("dream", judge=False)
    monkeypatch.setattr(imagined_data, "open_world", lambda _: world)
    flags = {"episodes": str(store.root), "output": str(target), "checkpoint": tmp_path}
    made = imagined_data.imagine_all(store.list(), **flags)
    assert len(made) == 2
    assert EpisodeStore(target).list() == sorted(made)
    told = capsys.readouterr().err
    assert "reach-2-0" in told
    assert "hands moved too long" in told


def test_judged_steps_are_three_at_every_end(truth):
    episode = truth.open(truth.list()[0])
    assert judged_steps(episode) == {6, 7, 8, 62, 63, 64, 77, 78, 79, 80}


@pytest.mark.long
def test_a_judge_sees_what_it_would_have_seen_of_all_images(truth, checkpoint, tmp_path):
    report = tmp_path / "counts.json"
    flags = ["--episodes", truth.root, "--store", tmp_path / "few", "--checkpoint", checkpoint]
    assert imagined_main([*map(str, flags), "--json", str(report), "--jobs", "2"]) == 0
    assert json.loads(report.read_text()) == {"imagined": 1}
    few, every = EpisodeStore(tmp_path / "few"), EpisodeStore(tmp_path / "every")
    world = open_world(checkpoint)
    assert isinstance(world, StateWorld)
    app = create_world_app({WORLD: world}, WorldServiceSettings())
    source = truth.open(truth.list()[0])
    with served({"imagined": app}) as urls, RolloutClient(urls["imagined"]) as client:
        name = imagine_episode(source, client, WORLD, every)
    assert few.list() == every.list() == [name]
    # Step 0, and the chunks of four that hold 6 … 8, 62 … 64 and 77 … 80.
    shown = few.open(name).shown_steps("camera_head")[0]
    assert shown.tolist() == [0, *range(5, 9), *range(61, 65), *range(77, 81)]
    ours, theirs = (read_ending_episode(store.open(name)) for store in (few, every))
    assert set(ours.endings) == set(theirs.endings) == {8, 64, 79, 80}
    for step, ending in ours.endings.items():
        wanted = theirs.endings[step]
        # Stored images are compressed together, so they are alike but not the same.
        difference = ending.images.astype(int) - wanted.images
        assert np.abs(difference).mean() < 2.0
        np.testing.assert_allclose(ending.tactile_kpa, wanted.tactile_kpa, atol=1e-3)
        np.testing.assert_allclose(ending.object_poses, wanted.object_poses, atol=1e-5)


def test_an_episode_made_of_another_is_the_source_of_what_is_imagined(tmp_path):
    """As an episode that was exported and imported again."""
    store, item = EpisodeStore(tmp_path), toy.demonstration("reach", 3)
    lineage = [LineageEntry(kind="episode", id="exported")]
    toy_store.write(store, item, episode_id="imported", lineage=lineage)
    lineage.append(LineageEntry(kind="episode", id="imported"))
    toy_store.write(store, item, episode_id="imagined", lineage=lineage, origin="imagined")
    assert _picture(store, store.open("imagined"), 2).title == "reach: imported"


def test_seeds_are_written_as_a_range():
    assert seed_range("3:7") == range(3, 7)
    for wrong in ("7:3", "3", "a:b", "-1:4", "3:3", ""):
        with pytest.raises(argparse.ArgumentTypeError, match="FIRST:LAST"):
            seed_range(wrong)


def test_episodes_are_chosen_by_task_and_seed(truth):
    def ids(tasks, seeds):
        return [about.episode_id for about in chosen_episodes(truth, tasks, seeds)]

    assert ids(None, None) == ids(("stand_bottle",), range(4, 5)) == truth.list()
    with pytest.raises(NotFoundError, match="1 of task 'stand_bottle'"):
        ids(("stack_bowls",), None)
    with pytest.raises(NotFoundError, match="of other seeds"):
        ids(None, range(5, 9))


def test_an_episode_without_an_image_of_its_first_step_is_not_imagined(tmp_path):
    store, item = EpisodeStore(tmp_path), toy.demonstration("reach", 3)
    toy_store.write(store, item, shown=range(8, toy.STEPS))
    with pytest.raises(NotFoundError, match="without an image of their first step"):
        chosen_episodes(store, None, None)


def test_episodes_with_few_images_were_never_trained_on_in_the_papers_form(tmp_path):
    store, item = EpisodeStore(tmp_path / "takes"), toy.demonstration("reach", 3)
    toy_store.write(store, item, shown=range(0, toy.STEPS, 4))
    shape = NetworkConfig(
        image_px=32, video_width=32, tactile_width=32, num_layers=1, num_heads=2, head_width=16
    )
    about = CheckpointMetadata(
        name="x", network=shape, tasks=("reach",), command="x", seed=0, training_steps=0,
        training_cpu_s=0, train_episode_ids=(), train_fingerprints=("x",), data_hash="x",
    )  # fmt: skip
    path = tmp_path / "model.safetensors"
    write_checkpoint(path, JointWorldModel(shape), about)
    refuse_trained_episodes(store, store.list(), path, command="evaluate recorded")


def test_the_number_of_processes_is_positive():
    assert positive("2") == 2
    for wrong in ("0", "-1", "a", ""):
        with pytest.raises(argparse.ArgumentTypeError, match="at least 1"):
            positive(wrong)
