"""The shipped model of the paper's form against simple rivals, on twin episodes made here."""

import sys

import numpy as np
import pytest
import torch

from dextouch.episodes import EpisodeStore
from dextouch.tactile.layout import DEXTOUCH_V1
from services.twin.episodes import TakeOptions, record, write_episode
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.world_model.checkpoints import read_checkpoint
from services.world_model.shipped_checkpoints import paper_form_checkpoint
from services.world_model.training.evaluation import evaluate_prediction, predict_all
from services.world_model.training.joint_dataset import EpisodeArrays, WindowPosition, load_episodes

# Far from the seeds of training and of the checkpoint's own held-out set.
FIRST_SEED = 20_000
EPISODES_PER_TASK = 2
FALSE_ALARM_N = 0.5
MAX_FALSE_ALARMS = 0.15


@pytest.fixture(scope="module")
def shipped():
    torch.set_num_threads(1)
    return read_checkpoint(paper_form_checkpoint())


def recorded(folder, *, miss: bool) -> list[EpisodeArrays]:
    store = EpisodeStore(folder)
    options = TakeOptions(miss=miss, images=("camera_head",))
    for task in ("stand_bottle", "stack_bowls"):
        stage = Stage(task, "robot", TwinSettings())
        for seed in range(FIRST_SEED, FIRST_SEED + EPISODES_PER_TASK):
            write_episode(store, record(stage, seed, options))
    return load_episodes(str(store.root))


@pytest.fixture(scope="module")
def episodes(tmp_path_factory) -> list[EpisodeArrays]:
    return recorded(tmp_path_factory.mktemp("heldout"), miss=False)


@pytest.fixture(scope="module")
def figures(shipped, episodes):
    prints = shipped.metadata.train_fingerprints
    found = {
        kind: evaluate_prediction(
            shipped.model, episodes, train_fingerprints=prints, action_kind=kind
        )
        for kind in ("commanded", "measured")
    }
    sys.stdout.write(f"\n{'figure':<27}{'commanded':>12}{'measured':>12}\n")
    for name in found["commanded"]:
        values = "".join(f"{found[kind][name]:12.3f}" for kind in found)
        sys.stdout.write(f"{name:<27}{values}\n")
    return found


@pytest.mark.parametrize("kind", ["commanded", "measured"])
@pytest.mark.slow
def test_sight_beats_copying(figures, kind):
    assert figures[kind]["psnr"] > figures[kind]["psnr_copy"] + 2.8
    assert figures[kind]["psnr"] < figures[kind]["psnr_codec"]


@pytest.mark.parametrize("kind", ["commanded", "measured"])
@pytest.mark.slow
def test_touch_beats_copying_and_nothing(figures, kind):
    rivals = figures[kind]["tactile_mse_copy"], figures[kind]["tactile_mse_zero"]
    # Reached: 0.143 with commanded actions, 0.119 with measured ones.
    assert figures[kind]["tactile_mse"] < 0.18 * min(rivals)
    assert figures[kind]["contact_f1"] > figures[kind]["contact_f1_copy"] + 0.15


@pytest.mark.parametrize("kind", ["commanded", "measured"])
@pytest.mark.slow
def test_false_actions_for_the_same_moment_are_seen_and_felt(figures, kind):
    given = figures[kind]
    # Most of what images gain over standing still is the head's own motion.
    for rival, psnr_db, touch in (
        ("other_take", 2.0, 1.25), ("hold", 1.9, 4.0), ("hands_still", 0.4, 4.0)
    ):  # fmt: skip
        assert given[f"psnr_{rival}"] < given["psnr"] - psnr_db
        assert given[f"tactile_mse_{rival}"] > touch * given["tactile_mse"]


def test_the_shipped_model_is_small_and_knows_its_history(shipped):
    assert paper_form_checkpoint().stat().st_size < 5e6
    metadata = shipped.metadata
    assert metadata.command
    assert len(metadata.train_fingerprints) == len(metadata.train_episode_ids) > 0
    assert np.isfinite(list(metadata.metrics.values())).all()
    assert metadata.metrics["psnr"] > metadata.metrics["psnr_copy"]
    assert not set(metadata.train_episode_ids) & set(metadata.heldout_episode_ids)


@pytest.mark.slow
def test_it_looks_before_it_feels(shipped, tmp_path):
    """With the objects elsewhere the same motions must not be felt: touch follows sight."""
    windows = [
        episode.cut(WindowPosition(0, start, 17, action_kind="commanded"))
        for episode in recorded(tmp_path, miss=True)
        for start in range(0, 65, 8)
    ]
    areas = DEXTOUCH_V1.areas_m2
    truth_n = np.stack([(w.tactile_kpa * 1e3) @ areas for w in windows]).max(axis=1)
    future = predict_all(shipped.model, [w.request for w in windows])
    felt_n = ((future.tactile_kpa * 1e3) @ areas).max(axis=1)
    free = truth_n < 0.05
    share = float((felt_n[free] > FALSE_ALARM_N).mean())
    sys.stdout.write(
        f"\nfalse alarms over {FALSE_ALARM_N} N in {share:.1%} of {free.sum()} free hand-windows"
        f" | bound {MAX_FALSE_ALARMS:.0%}\n"
    )
    assert free.sum() > 40
    assert share < MAX_FALSE_ALARMS
