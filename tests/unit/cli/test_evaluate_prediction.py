"""`dextouch evaluate prediction`: figures of recorded episodes by task, and what it refuses."""

import json

import pytest

from dextouch.episodes import EpisodeStore
from services.cli import main
from services.evaluation.prediction import DEFAULT_BASELINES, MODEL
from services.twin.episodes import TakeOptions, record, write_episode
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.world_model.checkpoints import paper_form_checkpoint


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    store = EpisodeStore(tmp_path_factory.mktemp("heldout"))
    stage = Stage("stand_bottle", "robot", TwinSettings(image_height_px=64, image_width_px=64))
    for seed in (60_000, 60_001):
        options = TakeOptions(images=("camera_head",), frozen_from_step=30)
        write_episode(store, record(stage, seed, options))
    return store


def run(store, *more):
    checkpoint = str(paper_form_checkpoint())
    words = ["--episodes", str(store.root), "--checkpoint", checkpoint, *more]
    return main.main(["evaluate", "prediction", *words])


def test_windows_are_measured_by_task_beside_all_baselines(store, tmp_path, capsys):
    path = tmp_path / "result.json"
    metrics = "psnr,contact_f1"
    assert run(store, "--horizon", "windows", "--metrics", metrics, "--json", str(path)) == 0
    result = json.loads(path.read_text(encoding="utf-8"))
    assert set(result["windows"]) == {"all", "stand_bottle"}
    assert result["windows"]["all"] == result["windows"]["stand_bottle"]
    figures = result["windows"]["all"]
    assert set(figures) == {MODEL, *DEFAULT_BASELINES}
    assert set(figures[MODEL]) == {"psnr", "contact_f1"}
    assert figures["codec"]["psnr"] > figures["copy"]["psnr"]
    assert figures["warp"]["contact_f1"] is None
    assert "rollouts" not in result
    assert "PSNR (dB) ↑" in capsys.readouterr().out


def test_unknown_metrics_name_the_valid_ones(store, capsys):
    assert run(store, "--metrics", "psnr,lpisp") == 3
    assert "unknown metric 'lpisp'; valid: aesthetic_quality" in capsys.readouterr().err


def test_a_store_without_such_episodes_says_what_it_has(store, capsys):
    assert run(store, "--tasks", "insert_peg") == 3
    assert "no robot episode of insert_peg" in capsys.readouterr().err
