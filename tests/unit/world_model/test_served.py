"""The model behind the rollout routes: started from an observation, stepped, refused clearly."""

import hashlib
import shutil

import numpy as np
import pytest
from httpx import ASGITransport, AsyncClient

from dextouch.schemas import StartRequest, decode_answer, encode_start
from dextouch.worlds import create_world_app
from services.world_model.command_line import open_by_digest
from services.world_model.joint_world import JointWorld
from services.world_model.settings import WorldModelSettings
from services.world_model.shipped_checkpoints import PAPER_FORM, PRETRAINED, STATE_MODEL
from tests.unit.world_model.test_joint_world import make_start

FLOAT64 = {"content-type": "application/octet-stream; dtype=float64"}


@pytest.fixture
async def client(checkpoint):
    world = JointWorld(checkpoint)
    app = create_world_app({"tiny": world}, WorldModelSettings(), name="world_model")
    transport = ASGITransport(app, raise_app_exceptions=False)
    async with (
        app.router.lifespan_context(app),
        AsyncClient(transport=transport, base_url="http://localhost") as opened,
    ):
        yield opened


async def test_a_rollout_runs_over_http(client, toy_episode):
    episode = toy_episode(1)
    start = make_start(episode)
    request = StartRequest(world="tiny", task=start.task, seed=4, instruction=start.instruction)
    response = await client.post(
        "/v1/rollouts",
        content=encode_start(request, start),
        headers={"content-type": "application/msgpack"},
    )
    assert response.status_code == 201, response.text
    rollout = decode_answer(response.content, max_bytes=10**7).rollout
    chunk = episode.actions["commanded"][1:9]
    answer = await client.post(
        f"/v1/rollouts/{rollout.id}/chunks/0", content=chunk.tobytes(), headers=FLOAT64
    )
    assert answer.status_code == 200, answer.text
    observation = decode_answer(answer.content, max_bytes=10**7).observation
    assert observation.first_step == 1
    assert observation.tactile_kpa.shape == (8, 2, 320)
    broken = np.full((8, 67), np.nan)
    refused = await client.post(
        f"/v1/rollouts/{rollout.id}/chunks/1", content=broken.tobytes(), headers=FLOAT64
    )
    assert refused.status_code in {400, 422}
    assert refused.headers["content-type"] == "application/problem+json"


async def test_it_is_listed_with_its_digest(client, checkpoint):
    worlds = (await client.get("/v1/worlds")).json()["worlds"]
    assert worlds[0]["digest"] == checkpoint.digest
    assert worlds[0]["kind"] == "model"


def test_rollouts_of_another_checkpoint_continue_while_it_is_in_the_folder(tmp_path):
    for path in PRETRAINED.glob("*.safetensors"):
        shutil.copy(path, tmp_path)
    current = tmp_path / "current.safetensors"
    current.symlink_to(STATE_MODEL)
    settings = WorldModelSettings(checkpoint=current, sampling_steps=3)
    for name in (PAPER_FORM, STATE_MODEL):
        digest = hashlib.sha256((PRETRAINED / name).read_bytes()).hexdigest()
        world = open_by_digest(settings, settings.world_name, digest)
        assert world is not None
        assert world.description.digest == digest
    assert open_by_digest(settings, settings.world_name, "0" * 64) is None
