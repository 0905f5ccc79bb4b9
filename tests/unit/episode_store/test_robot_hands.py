"""Robot hands of an episode's actions, against MuJoCo's kinematics of the maker's model."""

import mujoco
import numpy as np
import pytest
from httpx import ASGITransport, AsyncClient

from dextouch.episodes import EpisodeStore
from dextouch.hands.actions import pack_action
from dextouch.hands.robot_hand import SIDES, RobotHand
from dextouch.streams import StreamDescriptor, unpack
from services.episode_store.app import create_app
from tests.unit.episode_store.episodes import POSES, write_episode
from tests.unit.hands.hand_texts import official_model
from tests.unit.hands.mujoco_chains import MujocoChains

NUM_STEPS = 5
# A quarter turn about z, and a shift: the wrists' poses at step 0.
QUARTER = np.array([[0.0, -1, 0, 0.3], [1, 0, 0, -0.2], [0, 0, 1, 0.9], [0, 0, 0, 1]])
GRID_NS = np.rint(np.arange(NUM_STEPS) * 1e9 / 15).astype(np.int64)


@pytest.fixture
def store(settings):
    return EpisodeStore(settings.store_url)


@pytest.fixture
async def http(settings):
    transport = ASGITransport(create_app(settings))
    async with AsyncClient(transport=transport, base_url="http://localhost") as client:
        yield client


def angles(side):
    hand, rng = RobotHand(side), np.random.default_rng(SIDES.index(side))
    return rng.uniform(hand.lower_rad, hand.upper_rad, (NUM_STEPS, 20))


def write_actions(store):
    """Wrists that move by 1 cm a step along the x axis of step 0, with random joint angles."""
    pose = np.tile([0.0, 0, 0, 1, 0, 0, 0, 1, 0], (NUM_STEPS, 1))
    pose[:, 0] = 0.01 * np.arange(NUM_STEPS)
    actions = pack_action(
        wrist_left=pose,
        wrist_right=pose,
        joints_left_rad=angles("left"),
        joints_right_rad=angles("right"),
        camera_head=pose,
    )
    attributes = write_episode(store, "template", num_steps=1).attributes
    anchor = type(attributes.anchor).model_validate(dict.fromkeys(POSES, QUARTER.tolist()))
    changes = {"episode_id": "hands", "streams": (), "anchor": anchor}
    with store.writer(attributes=attributes.model_copy(update=changes)) as writer:
        writer.add_stream(
            StreamDescriptor(
                name="action",
                kind="robot_state",
                shape=(67,),
                dtype="float64",
                unit="action",
                nominal_rate_hz=15,
            )
        )
        writer.append("action", values=actions, t_ref_ns=GRID_NS)


async def test_fingertips_are_those_of_the_makers_model(http, store):
    write_actions(store)
    query = {"start_ns": int(GRID_NS[1]), "stop_ns": int(GRID_NS[4])}
    answer = await http.get("/v1/playback/episode/hands/robot_hands", params=query)
    assert answer.status_code == 200, answer.text
    _, arrays = unpack(answer.content, max_bytes=1 << 20)
    np.testing.assert_array_equal(arrays["t_ns"], GRID_NS[1:4])
    for side in SIDES:
        model = mujoco.MjModel.from_xml_path(str(official_model(side)))
        chains = MujocoChains(model, f"{side[0]}_wrist", np.eye(3))
        tips = [model.site(index).name for index in range(model.nsite)]
        for row, step in enumerate((1, 2, 3)):
            chains.pose(RobotHand(side).joint_names, angles(side)[step])
            points = np.array([chains.site(name) for name in tips])
            wrist = QUARTER[:3, :3] @ [0.01 * step, 0, 0] + QUARTER[:3, 3]
            expected = points @ QUARTER[:3, :3].T + wrist
            got = arrays[f"{side}_points_world_m"][row, :, 3]
            np.testing.assert_allclose(got, expected, atol=1e-6)
            np.testing.assert_allclose(arrays[f"T_world_wrist_{side}"][row, :3, 3], wrist)
    again = {"if-none-match": answer.headers["etag"]}
    url = "/v1/playback/episode/hands/robot_hands"
    assert (await http.get(url, params=query, headers=again)).status_code == 304


async def test_a_span_without_steps_is_empty(http, store):
    write_actions(store)
    query = {"start_ns": 10**12, "stop_ns": 10**13}
    answer = await http.get("/v1/playback/episode/hands/robot_hands", params=query)
    _, arrays = unpack(answer.content, max_bytes=1 << 20)
    assert arrays["t_ns"].shape == (0,)


@pytest.mark.parametrize(
    ("name", "query", "status"),
    [
        ("e-1", {"action_kind": "commanded"}, 422),
        ("e-1", {"action_kind": "wished"}, 422),
        ("person", {}, 422),
        ("e-9", {}, 404),
    ],
)
async def test_what_has_no_robot_hand_is_refused(http, store, name, query, status):
    write_episode(store, "e-1")
    write_episode(store, "person", domain="human")
    span = {"start_ns": 0, "stop_ns": 10**9}
    answer = await http.get(f"/v1/playback/episode/{name}/robot_hands", params=span | query)
    assert answer.status_code == status, answer.text
    assert answer.json()["detail"]
