"""Parts of the demo that need no twin and no network weights."""

from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
import pytest
from fastapi import FastAPI

from dextouch.clients import PolicyStart
from dextouch.episodes import EpisodeStore
from dextouch.episodes.spool import SpoolWriter
from dextouch.errors import ConflictError, UnavailableError
from dextouch.schemas import LineageEntry
from services.evaluation.scores import REAL, RolloutScore
from services.pipelines.demo import Stages, show, worst_errors
from services.pipelines.demo_scoring import LADDER, MODEL, ladder, mistake_comment, mistake_rows
from services.pipelines.demo_takes import align, forget_take
from services.pipelines.parsers import FIRST_HELD_OUT_SEED, demo_plan
from services.pipelines.servers import bind, served
from services.pipelines.study import refuse_trained
from services.twin.mistakes import DEVELOPMENT
from services.twin.stage import mistake_of
from services.world_model.checkpoints import write_state_checkpoint
from tests.contracts.test_world import untrained_state_checkpoint
from tests.unit.bridges.takes import write_episode, write_recording
from tests.unit.worlds.fakes import anchor, observation


def test_a_take_of_an_earlier_run_is_replaced_with_its_episodes(tmp_path):
    store = EpisodeStore(tmp_path)
    for recording_id in ("demo-human", "demo-human-of-mine"):
        write_recording(store, recording_id, count=5, station="demo")
    made = LineageEntry(kind="recording", id="demo-human", sha256="0" * 64)
    write_episode(store, "demo-human-0123456789ab", num_steps=3, lineage=(made,))
    write_episode(store, "demo-human-of-mine-0123", num_steps=3)
    with SpoolWriter(
        tmp_path / ".uploads" / "demo-human", store.recording("demo-human").attributes
    ):
        pass
    for _ in range(2):
        forget_take(store, "demo-human")
        assert store.list() == ["demo-human-of-mine-0123"]
        assert store.list(kind="recording") == ["demo-human-of-mine"]
    assert store.trash_list() == []
    assert list((tmp_path / ".uploads").iterdir()) == []


def test_a_take_of_another_station_is_never_replaced(tmp_path):
    store = EpisodeStore(tmp_path)
    write_recording(store, "demo-human", count=5, station="bench-2")
    with pytest.raises(ConflictError, match="'demo-human', which station 'bench-2' made"):
        forget_take(store, "demo-human")
    assert store.list(kind="recording") == ["demo-human"]
    half_sent = tmp_path / ".uploads" / "demo-robot"
    with SpoolWriter(half_sent, store.recording("demo-human").attributes):
        pass
    with pytest.raises(ConflictError, match="bench-2"):
        forget_take(store, "demo-robot")
    assert half_sent.exists()


def test_an_alignment_that_does_not_answer_is_named():
    place = bind("alignment", host="127.0.0.1", port=0)
    url = place.url
    place.socket.close()
    with pytest.raises(UnavailableError, match="alignment of demo-human"):
        align(url, "demo-human")


def errors(scale):
    return {
        "clock_rms_ms": {"head": 0.1 * scale},
        "latency_ms": {"head": 4.0},
        "latency_error_ms": {"head": 0.01},
        "num_dropped": {"head": scale},
        "taxel_iou": 1.0 - 0.01 * scale,
        "taxel_mae_kpa": 0.003 * scale,
        "fingertip_error_mm": 1.0 * scale,
        "wrist_error_mm": 0.5 * scale,
        "wrist_error_deg": 0.05 * scale,
    }


def test_the_report_tells_the_worse_of_two_takes():
    worst = worst_errors({"human": errors(1), "robot": errors(2)})
    assert worst["taxel_iou"] == 0.98
    assert worst["wrist_error_mm"] == 1.0
    assert worst["clock_rms_ms"] == {"human.head": 0.1, "robot.head": 0.2}


def test_stages_keep_order_and_time_also_of_those_that_fail(capsys):
    stages = Stages()
    with stages.stage("one", "doing one"):
        pass
    with pytest.raises(ValueError, match="broken"), stages.stage("two", "doing two"):
        raise ValueError("broken")
    assert [row["name"] for row in stages.rows()] == ["one", "two"]
    assert "1. doing one" in capsys.readouterr().err


def test_services_answer_inside_the_block_and_are_gone_after_it():
    app = FastAPI()

    @app.get("/hello")
    async def hello() -> dict[str, str]:
        return {"answer": "hello"}

    with served({"hello": app}) as urls:
        answer = httpx.get(f"{urls['hello']}/hello", trust_env=False)
        assert answer.json() == {"answer": "hello"}
    with pytest.raises(httpx.ConnectError):
        httpx.get(f"{urls['hello']}/hello", trust_env=False)


def test_a_service_that_cannot_start_is_an_error():
    async def refuse(app):
        raise UnavailableError("no")
        yield

    app = FastAPI(lifespan=refuse)
    with pytest.raises(UnavailableError, match="did not start"), served({"broken": app}):
        pass


def test_held_out_seeds_are_never_training_seeds():
    plan = demo_plan(["--seeds", "3", "--output", "somewhere"])
    assert plan.output == Path("somewhere")
    assert min(plan.seeds) >= FIRST_HELD_OUT_SEED
    assert plan.take_seed not in plan.seeds
    with pytest.raises(SystemExit):
        demo_plan(["--seeds", "0"])


def test_the_table_shows_undefined_agreement(capsys):
    show(
        {
            "success_probe": {"held_out_accuracy": 0.8},
            "stages": [{"name": "truth", "seconds": 1.0}],
            "errors": errors(1),
            "world_model": dict.fromkeys(
                (
                    "psnr",
                    "psnr_copy",
                    "psnr_hold",
                    "psnr_other_take",
                    "psnr_hands_still",
                    "psnr_codec",
                    "tactile_mse",
                    "tactile_mse_copy",
                    "tactile_mse_zero",
                    "contact_f1",
                    "contact_f1_copy",
                ),
                1.0,
            ),
            "policies": [
                {"policy": "hold", "task": "t", "real": 0.0, "imagined": 0.5}
                | {"real_rollouts": 7, "imagined_rollouts": 6}
            ],
            "agreement": {
                "t": {
                    "pearson": "undefined",
                    "kendall": "undefined",
                    "mmrv": 0.1,
                    "mmrv_paper": 0.0,
                    "num_policies": 5,
                    "num_starts": 6,
                }
            },
            "comments": {"t": ["It flatters."]},
            "imagined_world": "world_model",
            "real_differences": {},
            "mistakes": [
                {"task": "t", "mistake": "tilt 0.5", "rollouts": 6, "real": 1, "imagined": 4}
                | {"wrong": 3, "cannot_tell": 0}
            ],
        }
    )
    shown = capsys.readouterr().out
    for words in (
        "undefined",
        "another scene",
        "≥ 0.98",
        "0.100",
        "It flatters.",
        "0.0 of 7",
        "tilt 0.5",
    ):
        assert words in shown


def test_policies_that_do_not_look_are_good_and_bad_ones():
    plan = replace(demo_plan(["--seeds", "1"]), levels_mm=(0.0, 30.0), mistakes=("tilt 0.5",))
    policies = ladder(plan)
    assert list(policies) == [
        "script 0 mm", "script 30 mm", "tilt 0.5", "hold", "retreat", "another scene's actions",
    ]  # fmt: skip
    assert not any(policy.uses_images for policy in policies.values())
    seed, task = plan.seeds[0], "stand_bottle"
    start = PolicyStart(task, "", seed, anchor(), np.eye(3))
    now = observation(seed=0)
    chunks = {}
    for name, policy in policies.items():
        policy.reset(start)
        chunks[name] = policy.act(now)
        assert chunks[name].shape == (16, 67)
    assert not np.array_equal(chunks["script 0 mm"], chunks["another scene's actions"])
    np.testing.assert_array_equal(chunks["hold"], np.repeat(chunks["hold"][:1], 16, axis=0))
    assert chunks["retreat"][-1, 11] != chunks["retreat"][0, 11]


def test_the_demo_shows_three_kinds_of_mistakes_that_no_training_data_contain():
    mistakes = [mistake_of(name) for name in demo_plan(["--seeds", "1"]).mistakes]
    assert len({mistake.kind for mistake in mistakes} & set(DEVELOPMENT)) >= 3


def test_rollouts_are_counted_by_kind_of_mistake():
    plan = replace(demo_plan(["--seeds", "2"]), levels_mm=(0.0, 30.0), mistakes=("tilt 0.5",))
    # Real and imagined success of the first and the second seed.
    outcomes = {"script 0 mm": "1111", "script 30 mm": "0001", "tilt 0.5": "0101"}
    scores = [
        RolloutScore(world, policy, task, seed, "", told[2 * index + number] == "1", 0.5, reason)
        for task in ("stand_bottle", "stack_bowls")
        for policy, told in outcomes.items()
        for index, seed in enumerate(plan.seeds)
        for number, (world, reason) in enumerate(((REAL, None), (MODEL, "unsure")))
    ]
    rows = mistake_rows(scores, plan)
    assert [(row["task"], row["mistake"]) for row in rows] == [
        (task, name) for task in ("stand_bottle", "stack_bowls") for name in (LADDER, "tilt 0.5")
    ]
    counted = [[row[n] for n in ("rollouts", "real", "imagined", "wrong")] for row in rows[:2]]
    assert counted == [[4, 2, 3, 1], [2, 0, 2, 2]]
    assert rows[1]["cannot_tell"] == 2
    comment = mistake_comment("stand_bottle", rows)
    assert "1 of 4 rollouts of scripts" in comment
    assert "2 of 2 with mistakes" in comment
    assert "(tilt 0.5)" in comment


def test_seeds_of_training_are_refused(tmp_path):
    loaded, path = untrained_state_checkpoint(), tmp_path / "state.safetensors"
    trained = {"training_seeds": {"press": (0, 219)}, "training_splits": ("A", "B", "C")}
    metadata = loaded.metadata.model_copy(update=trained)
    write_state_checkpoint(path, loaded.dynamics, loaded.renderer, metadata)
    refuse_trained("model", path, ["press"], range(220, 230))
    refuse_trained("model", path, ["pour"], range(219, 222))
    with pytest.raises(ConflictError, match=r"'press' with seeds 0 … 219.*seed 219"):
        refuse_trained("model", path, ["press"], range(219, 222))
