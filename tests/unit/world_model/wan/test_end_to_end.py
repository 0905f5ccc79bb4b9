"""The full architecture in miniature: trained, stored, read and served over HTTP."""

from dataclasses import replace

import pytest
import torch
from httpx import ASGITransport, AsyncClient
from torch.distributed.device_mesh import DeviceMesh

from dextouch.errors import InvalidInputError, UnavailableError
from dextouch.schemas import StartRequest, decode_answer, encode_start
from dextouch.worlds import create_world_app
from services.world_model.checkpoints import read_checkpoint
from services.world_model.command_line import open_worlds, run_show, run_train
from services.world_model.network.configuration import WanFiles
from services.world_model.paper_settings import (
    OptimizerSettings,
    TrainCommand,
    TrainSettings,
    WindowSettings,
)
from services.world_model.pretrained_video import initial_model
from services.world_model.settings import Placement, WorldModelSettings
from services.world_model.training.distribution import Processes
from services.world_model.training.joint_trainer import TrainingRun, train_on
from tests.unit.world_model.test_joint_world import make_start

INSTRUCTION = "push the box with both hands"


@pytest.fixture
def settings(full_config, pretrained_folder, tmp_path):
    return TrainSettings(
        episodes="unused",
        output=tmp_path / "full.safetensors",
        network=full_config,
        wan=WanFiles(folder=pretrained_folder, text_cache=tmp_path / "texts"),
        optimizer=OptimizerSettings(batch=2, warmup_steps=1),
        windows=WindowSettings(fit_windows=4),
        evaluation_stride=24,
        max_steps=2,
    )


async def _rollout(world_settings, start, chunks):
    worlds = open_worlds(world_settings)
    (name,) = worlds
    app = create_world_app(worlds, world_settings, name="world_model")
    transport = ASGITransport(app, raise_app_exceptions=False)
    async with (
        app.router.lifespan_context(app),
        AsyncClient(transport=transport, base_url="http://localhost") as client,
    ):
        request = StartRequest(world=name, task=start.task, seed=4, instruction=start.instruction)
        started = await client.post(
            "/v1/rollouts",
            content=encode_start(request, start),
            headers={"content-type": "application/msgpack"},
        )
        assert started.status_code == 201, started.text
        rollout = decode_answer(started.content, max_bytes=10**8).rollout
        observations = []
        for index, chunk in enumerate(chunks):
            answer = await client.post(
                f"/v1/rollouts/{rollout.id}/chunks/{index}",
                content=chunk.tobytes(),
                headers={"content-type": "application/octet-stream; dtype=float64"},
            )
            assert answer.status_code == 200, answer.text
            observations.append(decode_answer(answer.content, max_bytes=10**8).observation)
        return observations


@pytest.mark.parametrize("precision", ["float32", pytest.param("bfloat16", marks=pytest.mark.slow)])
async def test_a_trained_checkpoint_serves_rollouts(settings, large_episode, precision):
    wan = settings.network.wan.model_copy(update={"precision": precision})
    network = settings.network.model_copy(update={"wan": wan})
    settings = settings.model_copy(update={"network": network})
    episodes = [large_episode(seed) for seed in range(3)]
    report = train_on(episodes[:2], episodes[2:], settings)
    assert report.steps == 2
    assert report.metrics["num_windows"] > 0
    trained = read_checkpoint(report.checkpoint).model
    start = TrainingRun(episodes[:2], settings).model
    before, after = start.state_dict(), trained.state_dict()
    moved = {name for name in after if not torch.equal(before[name], after[name])}
    assert any(name.startswith("layers.0.video.block.attn1") for name in moved)
    assert any(name.startswith("layers.0.tactile") for name in moved)
    assert not any(name.startswith("codec.") for name in moved)
    episode = episodes[0]
    served = WorldModelSettings(
        checkpoint=report.checkpoint, placement=Placement(precision=precision)
    )
    actions = episode.actions["commanded"]
    first, second = await _rollout(served, make_start(episode), [actions[1:9], actions[9:17]])
    assert first.images["camera_head"].shape == (8, 64, 64, 3)
    assert second.first_step == 9
    assert second.tactile_kpa.shape == (8, 2, 320)
    world = open_worlds(served)["world_model"]
    with pytest.raises(InvalidInputError, match=r"--placement\.text\.folder"):
        world.reset(replace(make_start(episode), instruction="open the drawer"))


@pytest.mark.slow
def test_training_at_length_lowers_both_losses(settings, large_episode):
    episodes = [large_episode(seed) for seed in range(4)]
    longer = settings.model_copy(
        update={"max_steps": 150, "optimizer": OptimizerSettings(batch=4, learning_rate=3e-3)}
    )
    report = train_on(episodes[:3], episodes[3:], longer)
    first, last = report.log[0], report.log[-1]
    assert last.loss_video < 0.8 * first.loss_video
    assert last.loss_tactile < 0.8 * first.loss_tactile


@pytest.mark.slow
def test_training_resumes_and_continues_from_a_checkpoint_without_the_folder(
    settings, large_episode
):
    episodes = [large_episode(seed) for seed in range(3)]
    report = train_on(episodes[:2], episodes[2:], settings)
    alone = settings.model_copy(
        update={
            "wan": WanFiles(), "init": report.checkpoint, "max_steps": 1,
            "output": settings.output.with_name("more.safetensors"),
        }
    )  # fmt: skip
    more = train_on(episodes[:2], episodes[2:], alone)
    features = read_checkpoint(more.checkpoint).model.text_features
    assert len(features.of(INSTRUCTION)) > 1
    with pytest.raises(InvalidInputError, match=r"--wan\.folder"):
        features.of("stand the box")
    with pytest.raises(InvalidInputError, match="no folder"):
        TrainingRun(episodes[:2], settings.model_copy(update={"wan": WanFiles()}))


@pytest.mark.parametrize("preset", ["wan22-5b", "wan-tiny", "wan22-5b-lora"])
def test_presets_name_the_full_size_and_its_miniature(preset):
    given = TrainCommand(preset=preset, episodes="unused")
    assert given.network.video_expert == "wan"
    assert given.network.tactile_tokens == "pad"
    assert given.name == preset
    full = preset != "wan-tiny"
    assert (given.network.wan.ffn_width, given.network.num_layers) == (
        (14336, 30) if full else (32, 2)
    )


@pytest.mark.long
def test_plans_are_printed_instead_of_training_and_provenance(checkpoint, tmp_path, capsys):
    assert checkpoint.digest
    assert run_show(["--checkpoint", str(tmp_path / "untrained.safetensors"), "--plan"]) == 0
    assert "one action chunk of 16 steps, 20 video and 34" in capsys.readouterr().out
    assert run_train(["--preset", "tiny", "--episodes", "unused", "--plan"]) == 0
    assert "one action chunk of 16 steps, 80 video and 34" in capsys.readouterr().out


def test_a_device_that_is_not_here_is_named(settings, large_episode):
    elsewhere = settings.model_copy(update={"device": "cuda:99"})
    with pytest.raises(UnavailableError, match="cuda:99"):
        TrainingRun([large_episode(0)], elsewhere)


def test_sharded_weights_have_one_precision(full_config, pretrained_folder):
    wan = full_config.wan.model_copy(update={"precision": "bfloat16"})
    files = WanFiles(folder=pretrained_folder)
    model = initial_model(full_config.model_copy(update={"wan": wan}), files)
    mesh = DeviceMesh.__new__(DeviceMesh)
    with pytest.raises(InvalidInputError, match=r"bfloat16, torch\.float32 in 2 processes"):
        Processes(0, 2, mesh).shard(model, model.layers)
