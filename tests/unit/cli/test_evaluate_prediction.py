"""`dextouch evaluate prediction`: figures of recorded episodes by task, and what it refuses."""

import json
from dataclasses import replace

import pytest

from dextouch.episodes import EpisodeStore
from services.cli import main
from services.evaluation.prediction import DEFAULT_BASELINES, MODEL
from services.twin.episodes import TakeOptions, record, write_episode
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.world_model.shipped_checkpoints import paper_form_checkpoint

pytestmark = pytest.mark.long


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


def test_recorded_episodes_have_the_baseline_of_another_take(store, tmp_path, capsys):
    """Those of a station have no seed; a single one names what is missing, and why."""
    recorded = EpisodeStore(tmp_path / "recorded")
    stage = Stage("stand_bottle", "robot", TwinSettings(image_height_px=64, image_width_px=64))
    path, words = tmp_path / "result.json", ["--horizon", "windows", "--metrics", "psnr"]
    missing = []
    for seed in (60_000, 60_001):
        take = record(stage, seed, TakeOptions(images=("camera_head",), frozen_from_step=30))
        unnamed = {"origin": "recorded", "seed": None, "episode_id": f"take-{seed}"}
        attributes = take.attributes.model_copy(update=unnamed)
        write_episode(recorded, replace(take, attributes=attributes))
        assert run(recorded, *words, "--json", str(path)) == 0
        result = json.loads(path.read_text(encoding="utf-8"))
        missing.append(result["missing_baselines"]["windows"])
        shown = capsys.readouterr().out
        why = "other_take is missing: no other take of the task is as long from this step"
        assert (why in shown) is (seed == 60_000)
    assert missing[0]["other_take"].startswith("no other take of the task is as long")
    assert "other_take" not in missing[1]
    assert result["windows"]["all"]["other_take"]["psnr"] is not None


def test_takes_shorter_than_a_chunk_are_left_out(tmp_path, capsys):
    stage = Stage("stand_bottle", "robot", TwinSettings(image_height_px=64, image_width_px=64))
    take = record(stage, 60_000, TakeOptions(images=("camera_head",)))
    attributes = take.attributes.model_copy(update={"episode_id": "short", "seed": 60_001})
    streams = {
        name: replace(stream, t_ref_ns=stream.t_ref_ns[kept], values=stream.values[kept])
        for name, stream in take.streams.items()
        for kept in [stream.t_ref_ns <= round(9e9 / 15)]
    }
    mixed = EpisodeStore(tmp_path / "mixed")
    for one in (take, replace(take, attributes=attributes, streams=streams)):
        write_episode(mixed, one)
    assert mixed.open("short").num_steps == 10
    words = ["--horizon", "rollouts", "--metrics", "psnr", "--baselines", "copy"]
    assert run(mixed, *words) == 0
    assert "rollouts: 1 from 1 episodes" in capsys.readouterr().out


def test_unknown_metrics_name_the_valid_ones(store, capsys):
    assert run(store, "--metrics", "psnr,lpisp") == 3
    assert "unknown metric 'lpisp'; valid: aesthetic_quality" in capsys.readouterr().err


def test_a_store_without_such_episodes_says_what_it_has(store, capsys):
    assert run(store, "--tasks", "insert_peg") == 3
    error = capsys.readouterr().err
    assert "no robot episode of insert_peg" in error
    assert "2 of task 'stand_bottle'" in error
