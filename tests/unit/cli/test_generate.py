"""`dextouch generate`: which episodes it takes and refuses, and who may train on the results."""

import json

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore, split_of
from dextouch.errors import NotFoundError
from services.cli import main
from services.evaluation.policies.cloning_training import read_cloning_episodes
from services.twin.episodes import TakeOptions, record, write_episode
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.world_model.checkpoints import write_state_checkpoint
from services.world_model.training.joint_dataset import load_episodes
from tests.contracts.test_world import untrained_state_checkpoint

pytestmark = pytest.mark.long

SEEDS = (4, 5, 8)


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    """Exact demonstrations, and one that fails."""
    store = EpisodeStore(tmp_path_factory.mktemp("truth"))
    stage = Stage("stand_bottle", "robot", TwinSettings(image_height_px=32, image_width_px=32))
    for seed in SEEDS:
        write_episode(store, record(stage, seed, TakeOptions(images=("camera_head",))))
    still = TakeOptions(images=("camera_head",), frozen_from_step=0)
    write_episode(store, record(stage, 9, still))
    return store


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """An untrained model that claims to know the scenes 4 … 8 of split B: seed 5, not seed 4."""
    path = tmp_path_factory.mktemp("model") / "untrained.safetensors"
    loaded = untrained_state_checkpoint()
    metadata = loaded.metadata.model_copy(
        update={"training_seeds": {"stand_bottle": (4, 8)}, "training_splits": ("B",)}
    )
    write_state_checkpoint(path, loaded.dynamics, loaded.renderer, metadata)
    return path


@pytest.fixture
def generate(truth, checkpoint, tmp_path):
    def run(*more, **flags):
        words = {"episodes": truth.root, "store": tmp_path / "imagined", "checkpoint": checkpoint}
        words |= {"jobs": 1, "json": tmp_path / "made.json"} | flags
        line = [word for name, value in words.items() for word in (f"--{name}", str(value))]
        status = main.main(["generate", *line, *more])
        report = tmp_path / "made.json"
        return status, json.loads(report.read_text())["episodes"] if report.exists() else []

    return run


def split_of_seed(store, seed):
    (split,) = {
        split_of(about)
        for about in (store.open(one).attributes for one in store.list())
        if about.seed == seed
    }
    return split


def test_demonstrations_are_imagined_whole(generate, truth, tmp_path):
    strips = tmp_path / "strips.html"
    status, made = generate(seeds="4:5", strips=strips)
    assert status == 0
    target = EpisodeStore(tmp_path / "imagined")
    assert made == target.list()
    (episode,) = [target.open(one) for one in made]
    (source,) = [one for one in truth.list() if truth.open(one).attributes.seed == 4]
    assert (episode.attributes.origin, episode.attributes.success) == ("imagined", True)
    assert episode.shown_steps("camera_head")[0].tolist() == list(range(81))
    commanded = truth.open(source).read("action_commanded").values
    np.testing.assert_array_equal(episode.read("action_commanded").values, commanded)
    first = truth.open(source).window(0, 1, cameras=("camera_head",))
    again = episode.window(0, 1, cameras=("camera_head",))
    assert np.abs(again.images["camera_head"].astype(int) - first.images["camera_head"]).max() < 40
    np.testing.assert_array_equal(again.tactile_kpa, first.tactile_kpa)
    page = strips.read_text()
    assert source in page
    assert page.count("data:image/png") == 2 * 2 * 8
    # Once more: nothing is made anew.
    before = target.fingerprints({made[0]: 0})
    assert generate(seeds="4:5") == (0, made)
    assert target.fingerprints({made[0]: 0}) == before


def test_scenes_of_the_world_model_are_refused(generate, truth, capsys):
    assert (split_of_seed(truth, 4), split_of_seed(truth, 5)) == ("A", "B")
    status, _ = generate(seeds="4:6")
    assert status == 3
    error = capsys.readouterr().err
    assert "was trained on the scenes of 1 of 2 episodes" in error
    assert "--split" in error
    assert generate(seeds="4:6", split="A")[0] == 0


def test_failures_are_imagined_on_request_only(generate, capsys):
    status, _ = generate(seeds="9:10")
    assert status == 3
    assert "that failed" in capsys.readouterr().err
    status, made = generate("--with-failures", seeds="9:10")
    assert (status, len(made)) == (0, 1)


def test_imagined_episodes_are_trained_on_only_when_asked(generate, truth, tmp_path):
    generate(seeds="4:5")
    imagined = EpisodeStore(tmp_path / "imagined")
    with pytest.raises(NotFoundError, match="1 of origin 'imagined'"):
        load_episodes(str(imagined.root))
    assert len(load_episodes(str(truth.root))) == 4
    scenes = [one.scene for one in read_cloning_episodes(truth)]
    assert sorted(scenes) == [f"stand_bottle/{seed}" for seed in SEEDS]
    assert len(read_cloning_episodes(truth, imagined)) == 3
    assert len(read_cloning_episodes(truth, imagined, imagined=True)) == 1
    assert [one.scene for one in read_cloning_episodes(truth, splits=("B",))] == ["stand_bottle/5"]
