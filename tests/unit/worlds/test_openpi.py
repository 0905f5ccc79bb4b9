"""Rollouts over the WebSocket, by a client that knows openpi's protocol and nothing of ours."""

from contextlib import contextmanager

import msgpack
import numpy as np
import pytest
from fastapi.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from dextouch.clients import RolloutClient
from dextouch.errors import AccessDeniedError
from dextouch.worlds import CopyFirstWorld, WorldServiceSettings, create_world_app
from dextouch.worlds.openpi import largest_message
from services.pipelines.servers import served as serve
from tests.unit.worlds import fakes
from tests.unit.worlds.running import served

KEY = "a-key-of-sixteen-letters"
START = {"world": "sum", "task": "stand_bottle", "seed": 3, "instruction": "stand it up"}


def encoded(value):
    """An array as openpi's clients write it."""
    shape, data = value.shape, value.tobytes()
    return {b"__ndarray__": True, b"data": data, b"dtype": value.dtype.str, b"shape": shape}


def decoded(found):
    if b"__ndarray__" not in found:
        return found
    return np.frombuffer(found[b"data"], found[b"dtype"]).reshape(found[b"shape"])


class Client:
    """Sends one message at a time; text is an error."""

    def __init__(self, connection):
        self.connection = connection
        self.metadata = self.receive()

    def receive(self):
        answer = self.connection.recv(timeout=20)
        if isinstance(answer, str):
            raise RuntimeError(answer)  # noqa: TRY004 - as openpi's client does
        return msgpack.unpackb(answer, object_hook=decoded)

    def infer(self, message):
        self.connection.send(msgpack.packb(message, default=encoded))
        return self.receive()


@contextmanager
def opened(url, key=None):
    headers = {"Authorization": f"Api-Key {key}"} if key else None
    address = url.replace("http", "ws") + "/v1/openpi"
    given = {"compression": None, "max_size": None, "additional_headers": headers, "proxy": None}
    with connect(address, **given) as connection:
        yield Client(connection)


@pytest.fixture(scope="module")
def url():
    app = create_world_app({"sum": fakes.SumWorld()}, WorldServiceSettings())
    with served(app) as address:
        yield address


def over_http(url, num_chunks):
    with RolloutClient(url) as client:
        rollout = client.start(**START)
        seen = [rollout.observation]
        return seen + [rollout.step(fakes.actions(8, value=n)) for n in range(num_chunks)]


def test_a_rollout_is_that_of_the_http_routes(url):
    expected = over_http(url, 2)
    with opened(url) as client:
        assert [world["name"] for world in client.metadata["worlds"]] == ["sum"]
        answers = [client.infer({"start": START})]
        answers += [client.infer({"actions": fakes.actions(8, value=n)}) for n in range(2)]
        assert answers[2]["rollout"]["next_chunk"] == 2
        rollout_id = answers[2]["rollout"]["id"]
        assert client.infer({"end": True}) == {"ended": rollout_id}
        with pytest.raises(RuntimeError, match="there is no rollout"):
            client.infer({"actions": fakes.actions(8)})
    for answer, truth in zip(answers, expected, strict=True):
        np.testing.assert_array_equal(answer["tactile_kpa"], truth.tactile_kpa)
        np.testing.assert_array_equal(answer["action_reached"], truth.action_reached)
        for camera, images in truth.images.items():
            np.testing.assert_array_equal(answer[f"image/{camera}"], images)
        assert answer["observation"]["first_step"] == truth.first_step


def test_a_lost_connection_resumes_and_a_chunk_is_applied_once(url):
    with opened(url) as client:
        rollout_id = client.infer({"start": START})["rollout"]["id"]
        first = client.infer({"actions": fakes.actions(8), "chunk": 0})
    with opened(url) as client:
        assert client.infer({"resume": rollout_id})["rollout"]["next_chunk"] == 1
        again = client.infer({"actions": fakes.actions(8), "chunk": 0})
        assert (again["replayed"], first["replayed"]) == (True, False)
        np.testing.assert_array_equal(again["tactile_kpa"], first["tactile_kpa"])
        with pytest.raises(RuntimeError, match="expected chunk 1"):
            client.infer({"actions": fakes.actions(8), "chunk": 5})
        assert client.infer({"actions": fakes.actions(8)})["rollout"]["next_chunk"] == 2


def test_answers_hold_what_was_asked_for(url):
    with opened(url) as client:
        client.infer({"start": START, "return": {"cameras": [], "steps": "last"}})
        answer = client.infer({"actions": fakes.actions(8)})
        assert not [name for name in answer if name.startswith("image/")]
        assert answer["tactile_kpa"].shape == (1, 2, 320)


def test_a_refused_message_selects_nothing(url):
    with opened(url) as client:
        client.infer({"start": START})
        with pytest.raises(RuntimeError, match="expected an array"):
            client.infer({"actions": 1, "return": {"steps": "last"}})
        assert client.infer({"actions": fakes.actions(8)})["tactile_kpa"].shape == (8, 2, 320)


@pytest.mark.parametrize(
    ("message", "error"),
    [
        ({}, "got the keys none"),
        ({"start": START, "end": True}, "expected one of start, resume, actions, end"),
        ({"start": START, "more": 1}, "got the keys more, start"),
        ({"start": START | {"world": "none"}}, "'none'"),
        ({"start": {"world": "sum"}}, "task"),
        ({"start": "now"}, "start"),
        ({"start": START, "return": {"steps": "some"}}, "return"),
        ({"resume": "0" * 32}, "0000"),
        ({"actions": [[1.0]]}, "got list, expected an array"),
        ({"actions": np.zeros((8, 66))}, "67"),
        ({"actions": np.full((8, 67), np.nan)}, "NaN"),
        ({"actions": np.zeros((8, 67)), "chunk": "0"}, "expected a whole number"),
    ],
)
def test_a_refused_message_changes_nothing(url, message, error):
    with opened(url) as client:
        if "start" not in message:
            client.infer({"start": START})
        with pytest.raises(RuntimeError, match=error):
            client.infer(message)
        if "start" not in message:
            answer = client.infer({"actions": fakes.actions(8)})
            assert answer["rollout"]["next_chunk"] == 1


@pytest.mark.parametrize(
    ("message", "error"),
    [
        ("hello", "got text"),
        (b"\xc1", "not msgpack"),
        (b"\0" * 100_000, "got 100000 bytes, expected at most 68480"),
    ],
)
def test_what_is_no_message_is_answered(url, message, error):
    with opened(url) as client:
        client.connection.send(message)
        with pytest.raises(RuntimeError, match=error):
            client.receive()
        assert client.infer({"start": START})["rollout"]["next_chunk"] == 0


def camera_message(size_px, cameras, dtype=">f8"):
    """A start from images, in the byte order of another machine."""
    rng = np.random.default_rng(0)
    images = {
        f"image/{camera}": rng.integers(0, 255, (1, size_px, size_px, 3), np.uint8)
        for camera in cameras
    }
    poses = {name: np.eye(4) for name in ANCHOR_NAMES} | {"K_head": np.diag([300.0, 300.0, 1.0])}
    touch = {"tactile_kpa": rng.random((1, 2, 320)).astype("<f4")}
    arrays = poses | {"action_reached": fakes.actions(1)}
    arrays = {name: array.astype(dtype) for name, array in arrays.items()} | images | touch
    return {"start": START | {"world": "copy-first"}, "observation": FIRST, **arrays}


# What a robot with three cameras of 448 px sends: 1.8 MB.
BIG_PX, BIG_CAMERAS = 448, ("camera_head", "camera_wrist_left", "camera_wrist_right")
ANCHOR_NAMES = ("T_world_wrist_left", "T_world_wrist_right", "T_world_camera_head")
FIRST = {"first_step": 0, "reached_is_measured": True}


@pytest.fixture(scope="module")
def camera_url():
    """Served with the limits of our own servers, by key."""
    world = CopyFirstWorld(
        tasks=("stand_bottle",),
        cameras=BIG_CAMERAS,
        image_height_px=BIG_PX,
        image_width_px=BIG_PX,
        model_rate_hz=15.0,
    )
    keys = ({"name": "policy", "key": KEY, "scopes": ["rollout"]},)
    settings = WorldServiceSettings.model_validate({"api_keys": keys})
    with serve({"worlds": create_world_app({"copy-first": world}, settings)}) as urls:
        yield urls["worlds"]


def test_a_rollout_starts_from_images_that_its_world_needs(camera_url):
    message = camera_message(BIG_PX, BIG_CAMERAS)
    with opened(camera_url, KEY) as client:
        seen = client.infer(message | {"return": {"cameras": ["camera_wrist_right"]}})
        np.testing.assert_array_equal(
            seen["image/camera_wrist_right"], message["image/camera_wrist_right"]
        )
        np.testing.assert_array_equal(seen["action_reached"], message["action_reached"])
        assert client.infer({"actions": fakes.actions(4)})["rollout"]["next_chunk"] == 1
        del message["observation"]
        with pytest.raises(RuntimeError, match="without 'observation'"):
            client.infer(message)
        # Arrays belong to a start.
        with pytest.raises(RuntimeError, match="got the keys actions, extra"):
            client.infer({"actions": fakes.actions(4), "extra": np.zeros(3)})
        # More than one observation of this world is not read.
        client.connection.send(b"\0" * 2_000_000)
        with pytest.raises(ConnectionClosed) as caught:
            client.receive()
        assert caught.value.rcvd.code == 1009


def test_the_limit_of_a_message_is_what_worlds_need():
    def limit(max_body_bytes=2**24, **changed):
        world = fakes.SumWorld().description.model_copy(update=changed)
        return largest_message([world], max_body_bytes=max_body_bytes)

    assert limit(starts_from=("task_seed",)) == 2**16
    # Two cameras of 8 px, two hands of 320 taxels as float32.
    assert limit() == 2**16 + 2 * 8 * 8 * 3 + 2 * 320 * 4
    assert limit(image_height_px=10_000) == 2**16 + 2 * 10_000 * 8 * 3 + 2 * 320 * 4
    assert limit(image_height_px=10_000, max_body_bytes=2**18) == 2**18
    assert limit(scales_images=True) == 2**24


def test_the_reason_of_a_refusal_fits_its_frame(monkeypatch):
    app = create_world_app({"sum": fakes.SumWorld()}, WorldServiceSettings())

    def refuse(*_args):
        raise AccessDeniedError("é" * 200)

    monkeypatch.setattr(app.state.access, "check", refuse)
    client = TestClient(app, base_url="http://localhost")
    url = "ws://localhost/v1/openpi"
    with pytest.raises(WebSocketDisconnect) as caught, client.websocket_connect(url):
        pass
    assert caught.value.reason == "é" * 61


def test_a_key_with_the_scope_is_needed_where_keys_are_set():
    keys = (
        {"name": "policy", "key": KEY, "scopes": ["rollout"]},
        {"name": "reader", "key": KEY[::-1], "scopes": ["read"]},
    )
    settings = WorldServiceSettings.model_validate({"api_keys": keys})
    app = create_world_app({"sum": fakes.SumWorld()}, settings)
    with served(app) as url:
        with opened(url, KEY) as client:
            assert client.infer({"start": START})["rollout"]["next_chunk"] == 0
            app.state.access.set_keys(settings.api_keys[1:])
            with pytest.raises(RuntimeError, match="unknown key"):
                client.infer({"start": START})
            app.state.access.set_keys(settings.api_keys)
            assert client.infer({"start": START})["rollout"]["next_chunk"] == 0
        for key in (None, "another-key-of-letters", KEY[::-1]):
            with pytest.raises((InvalidStatus, ConnectionClosed)), opened(url, key):
                pass
