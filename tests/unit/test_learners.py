"""All that learns from episodes, or measures with them, leaves out the same ones."""

import os
from dataclasses import replace
from datetime import UTC, datetime

import pytest

from dextouch.episodes import EpisodeStore
from dextouch.schemas import Review
from services.evaluation.endings import read_ending_episodes
from services.evaluation.policies.cloning_training import read_cloning_episodes
from services.evaluation.recorded_takes import read_takes
from services.pipelines.imagined_data import chosen_episodes
from services.twin.episodes import record, write_episode
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.take_options import TakeOptions
from services.world_model.settings import TrainStateCommand
from services.world_model.training.joint_dataset import index_episodes, load_episodes
from services.world_model.training.state_data import load_state_data
from services.world_model.training.tokenizer_trainer import load_hands

pytestmark = pytest.mark.long

LEARNERS = {
    "joint world model": load_episodes,
    "joint world model, streaming": index_episodes,
    "state world model": lambda url: load_state_data(TrainStateCommand(episodes=(url,))).episodes,
    "success classifier": lambda url: read_ending_episodes(EpisodeStore(url)),
    "cloned policy": lambda url: read_cloning_episodes(EpisodeStore(url)),
    "recorded takes": lambda url: read_takes([EpisodeStore(url)]),
    "imagination": lambda url: chosen_episodes(EpisodeStore(url), None, None),
}


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    """Two good takes, a rejected one, one of unknown outcome, and what was imagined of two."""
    store = EpisodeStore(tmp_path_factory.mktemp("learners"))
    stage = Stage("stand_bottle", "robot", TwinSettings(image_height_px=32, image_width_px=32))
    options = TakeOptions(images=("camera_head",), streams="training")
    for seed, name in enumerate(("good", "better", "rejected", "unknown"), 1):
        truth = record(stage, seed, options)
        lineage = [{"kind": "episode", "id": name}]
        success = None if name == "unknown" else True
        for changes in (
            {"episode_id": name, "success": success},
            {"episode_id": f"dream-{name}", "success": success, "origin": "imagined",
             "lineage": lineage},
        ):  # fmt: skip
            about = truth.attributes.model_validate(truth.attributes.model_dump() | changes)
            write_episode(store, replace(truth, attributes=about))
    store.set_review(
        "rejected", Review(verdict="rejected", reviewed_at=datetime(2026, 5, 4, tzinfo=UTC))
    )
    return os.fspath(store.root)


@pytest.mark.parametrize("name", LEARNERS)
def test_rejected_imagined_and_unknown_episodes_are_left_out_by_all(url, name):
    found = {episode.episode_id for episode in LEARNERS[name](url)}
    expected = {"good", "better"}
    if name == "success classifier":
        # It alone learns from what was imagined, too.
        expected |= {"dream-good", "dream-better"}
    if name in ("joint world model", "joint world model, streaming", "imagination"):
        # These need no outcome.
        expected |= {"unknown"}
    assert found == expected


def test_tokenizers_leave_them_out_too(url):
    training, heldout = load_hands([url], heldout_share=0.1)
    assert {*training.scenes, *heldout.scenes} == {f"stand_bottle/{seed}" for seed in (1, 2, 4)}
    assert len(training.tactile_kpa) + len(heldout.tactile_kpa) == 3 * 2 * 81
