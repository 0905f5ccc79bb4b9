"""The client against a real server: what a policy sees, retries that take nothing twice, errors."""

import socket
import threading

import numpy as np
import pytest

from dextouch.clients import HttpLink, RolloutClient
from dextouch.errors import (
    ConflictError,
    EndedError,
    InvalidInputError,
    LimitExceededError,
    NonFiniteError,
    NotFoundError,
    ShapeError,
    UnavailableError,
    UnknownNameError,
)
from dextouch.schemas import ReturnSelector
from dextouch.worlds import CopyFirstWorld, WorldServiceSettings, create_world_app
from dextouch.worlds.settings import RolloutLimits
from tests.unit.worlds.fakes import CAMERAS, K_HEAD, SumWorld, actions, anchor, observation
from tests.unit.worlds.running import served

ASKED = {"task": "stand_bottle", "seed": 3, "instruction": "stand the bottle"}


@pytest.fixture(scope="module")
def url():
    world = SumWorld()
    worlds = {"sum": world, "copy-first": CopyFirstWorld.beside(world.description)}
    settings = WorldServiceSettings(limits=RolloutLimits(max_rollouts=8))
    with served(create_world_app(worlds, settings)) as address:
        yield address


@pytest.fixture
def client(url):
    with RolloutClient(url) as opened:
        yield opened


def test_a_rollout_from_task_and_seed(client):
    assert [world.name for world in client.worlds()] == ["sum", "copy-first"]
    with client.start(world="sum", **ASKED) as rollout:
        assert len(rollout.observation) == 1
        assert rollout.observation.tactile_kpa[0, 0, 0] == 3.0
        np.testing.assert_array_equal(rollout.K_head, K_HEAD)
        expected = anchor().T_world_wrist_left
        np.testing.assert_array_equal(rollout.anchor.T_world_wrist_left, expected)
        seen = rollout.step(actions(16, 0.5))
        assert seen.first_step == 1
        assert seen.images[CAMERAS[1]].shape == (16, 8, 8, 3)
        assert seen.images[CAMERAS[1]].max() == 1
        np.testing.assert_array_equal(seen.action_reached, actions(16, 0.5))
        assert rollout.info.next_chunk == 1
        assert "noise" in rollout.reported
        assert rollout.step(actions(4)).first_step == 17


def test_no_images_and_the_last_step_only(client):
    blind = client.selecting(ReturnSelector(cameras=(), steps="last"))
    with blind.start(world="sum", **ASKED) as rollout:
        assert rollout.observation.images == {}
        seen = rollout.step(actions(16))
        assert (seen.first_step, len(seen), seen.images) == (16, 1, {})


def test_a_selector_of_one_chunk_alone(client):
    with client.start(world="sum", **ASKED) as rollout:
        assert rollout.step(actions(4), selector=ReturnSelector(cameras=())).images == {}
        seen = rollout.step(actions(8))
        assert (seen.first_step, set(seen.images)) == (5, set(CAMERAS))


def test_an_ended_rollout_is_an_error_of_its_own(client):
    with client.start(world="sum", **ASKED) as rollout:
        before = rollout.step(actions(4))
        for value in (4e6, 0.0):
            with pytest.raises(EndedError, match="branch") as caught:
                rollout.step(actions(4, value))
            assert caught.value.reason == "too many to count"
            assert caught.value.details["last_chunk"] == 0
        assert rollout.observation is before
        with rollout.fork() as branch:
            assert branch.step(actions(4)).first_step == 5


def test_a_rollout_from_an_observation(client):
    first = observation(seed=5)
    init = (first, anchor(), K_HEAD)
    with client.start(world="copy-first", init=init, **ASKED) as rollout:
        seen = rollout.step(actions(8, 0.2))
    for camera in CAMERAS:
        np.testing.assert_array_equal(seen.images[camera], first.images[camera].repeat(8, 0))
    np.testing.assert_array_equal(seen.tactile_kpa, first.tactile_kpa.repeat(8, 0))
    assert not seen.reached_is_measured


def test_same_seed_same_future_other_seed_another(client):
    def touch(seed):
        asked = ASKED | {"seed": seed}
        with client.start(world="sum", **asked) as rollout:
            rollout.step(actions(4))
            return rollout.step(actions(4)).tactile_kpa - seed

    np.testing.assert_array_equal(touch(1), touch(1))
    assert np.abs(touch(1) - touch(2)).max() > 1e-3


def test_the_selector_sends_less(url):
    selector = ReturnSelector(cameras=(CAMERAS[0],), steps="last")
    with (
        RolloutClient(url, selector=selector) as narrow,
        narrow.start(world="sum", **ASKED) as rollout,
    ):
        seen = rollout.step(actions(8))
    assert (seen.first_step, len(seen)) == (8, 1)
    assert set(seen.images) == {CAMERAS[0]}


def test_another_selector_on_the_same_connection(client):
    narrow = client.selecting(ReturnSelector(cameras=(CAMERAS[1],), steps="last"))
    with narrow.start(world="sum", **ASKED) as rollout:
        assert set(rollout.step(actions(8)).images) == {CAMERAS[1]}
    with client.start(world="sum", **ASKED) as rollout:
        assert set(rollout.step(actions(8)).images) == set(CAMERAS)
    with pytest.raises(InvalidInputError, match="tactile=True"):
        client.selecting(ReturnSelector(tactile=False)).start(world="sum", **ASKED)


def test_worlds_are_listed_by_the_names_that_starts_take():
    app = create_world_app({"world_model": SumWorld(name="tiny")}, WorldServiceSettings())
    with served(app) as address, RolloutClient(address) as client:
        (world,) = client.worlds()
        client.start(world=world.name, **ASKED).close()


def test_an_error_inside_is_not_hidden_by_one_of_closing(client, monkeypatch):
    rollout = client.start(world="sum", **ASKED)
    monkeypatch.setattr(rollout, "close", lambda: (_ for _ in ()).throw(UnavailableError("gone")))
    with pytest.raises(ZeroDivisionError), rollout:
        raise ZeroDivisionError
    with pytest.raises(UnavailableError), rollout:
        pass
    monkeypatch.undo()
    rollout.close()


def test_a_branch_shares_the_past_and_goes_its_own_way(client):
    with client.start(world="sum", **ASKED) as rollout:
        rollout.step(actions(4))
        with rollout.fork() as same, rollout.fork(seed=99) as other:
            expected = rollout.step(actions(4)).tactile_kpa
            np.testing.assert_array_equal(same.step(actions(4)).tactile_kpa, expected)
            assert np.abs(other.step(actions(4)).tactile_kpa - expected).max() > 1e-3


def test_refusals_arrive_as_their_own_class(client):
    with pytest.raises(UnknownNameError, match=r"valid: copy-first, sum"):
        client.start(world="moon", **ASKED)
    with pytest.raises(UnknownNameError, match="stack_bowls") as caught:
        client.start(world="sum", **(ASKED | {"task": "juggle"}))
    assert caught.value.details["valid"] == ["stack_bowls", "stand_bottle"]
    with pytest.raises(InvalidInputError, match="from task_seed, expected one of observation"):
        client.start(world="copy-first", **ASKED)
    with pytest.raises(InvalidInputError, match="seed"):
        client.start(world="sum", **(ASKED | {"seed": -1}))
    with client.start(world="sum", **ASKED) as rollout:
        with pytest.raises(ShapeError, match="multiple of 4"):
            rollout.step(actions(6))
        with pytest.raises(LimitExceededError, match="at most 16"):
            rollout.step(actions(20))
        bad = actions(4)
        bad[2, 30] = np.nan
        with pytest.raises(NonFiniteError, match="row 2, column 30"):
            rollout.step(bad)
        with pytest.raises(InvalidInputError, match="1e6 cannot"):
            rollout.step(actions(4, 1e6))
        assert rollout.step(actions(4)).first_step == 1


def test_a_closed_rollout_is_gone_and_may_be_closed_again(client):
    rollout = client.start(world="sum", **ASKED)
    rollout.close()
    rollout.close()
    with pytest.raises(NotFoundError):
        rollout.step(actions(4))


def test_too_many_rollouts(client):
    started = [client.start(world="sum", **ASKED) for _ in range(8)]
    client._link._patience_s = 0.0
    with pytest.raises(LimitExceededError, match="the limit of 8 rollouts is reached") as caught:
        client.start(world="sum", **ASKED)
    assert caught.value.details["retry_after_s"] == 1
    for rollout in started:
        rollout.close()


def test_a_lost_answer_is_given_again_not_computed_again(client, monkeypatch):
    with client.start(world="sum", **ASKED) as rollout, rollout.fork() as twin:
        connection = rollout._link._connection
        real, lost = connection.getresponse, []

        def lose_first():
            answer = real()
            if not lost:
                lost.append(answer.read())
                raise ConnectionResetError("the line is gone")
            return answer

        monkeypatch.setattr(connection, "getresponse", lose_first)
        seen = rollout.step(actions(4))
        assert lost
        assert rollout.info.next_chunk == 1
        np.testing.assert_array_equal(seen.tactile_kpa, twin.step(actions(4)).tactile_kpa)


def test_a_rollout_moved_on_by_another_is_a_conflict(client):
    with client.start(world="sum", **ASKED) as rollout:
        stale = rollout.info
        rollout.step(actions(4))
        rollout.info = stale
        with pytest.raises(ConflictError, match="expected chunk 1") as caught:
            rollout.step(actions(4, 0.5))
    assert caught.value.details["expected"] == 1


def test_no_service_there(free_port):
    pauses = []
    client = RolloutClient(f"http://127.0.0.1:{free_port}")
    client._link._pause = pauses.append
    with pytest.raises(UnavailableError, match="is the service running"):
        client.worlds()
    assert pauses == [0.05, 0.2, 0.8]


@pytest.mark.parametrize("url", ["127.0.0.1:80", "ftp://host", "http://"])
def test_an_address_must_be_one(url):
    with pytest.raises(InvalidInputError, match="address"):
        RolloutClient(url)


def test_images_as_jpeg_are_decoded_by_the_client(client):
    selector = ReturnSelector(steps="last", images="jpeg")
    with client.start(world="sum", **ASKED) as exact, client.start(world="sum", **ASKED) as rollout:
        raw = exact.step(actions(4), selector=ReturnSelector(steps="last"))
        seen = rollout.step(actions(4), selector=selector)
    assert seen.images.keys() == raw.images.keys()
    for camera, images in raw.images.items():
        assert seen.images[camera].shape == images.shape
    np.testing.assert_array_equal(seen.tactile_kpa, raw.tactile_kpa)


def test_a_request_arrives_whole():
    """In two pieces the server would wake up twice."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        link = HttpLink(f"http://127.0.0.1:{listening.getsockname()[1]}")
        found = []

        def serve() -> None:
            connection, _ = listening.accept()
            with connection:
                for _ in range(2):
                    found.append(connection.recv(65536))
                    connection.sendall(b"HTTP/1.1 200 OK\r\ncontent-length: 2\r\n\r\n{}")

        thread = threading.Thread(target=serve)
        thread.start()
        for body in (b"x" * 1000, None):
            assert link.request("POST", "/some", body=body).body == b"{}"
        thread.join()
        link.close()
    assert [data.count(b"\r\n\r\n") for data in found] == [1, 1]
    assert found[0].endswith(b"\r\n\r\n" + b"x" * 1000)
