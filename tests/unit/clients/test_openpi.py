"""Policies behind openpi's protocol, served by hand with websockets and msgpack alone."""

import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from unittest.mock import Mock

import msgpack
import numpy as np
import pytest
from websockets.sync.client import ClientConnection
from websockets.sync.server import serve

from dextouch.clients import OpenPiPolicy, PolicyStart
from dextouch.errors import InvalidInputError, ShapeError, UnavailableError
from dextouch.schemas import Observation
from services.evaluation.policies.user_policies import PolicySource
from tests.unit.worlds import fakes
from tests.unit.worlds.test_openpi import decoded, encoded

START = PolicyStart("stand_bottle", "stand it up", 0, fakes.anchor(), np.eye(3))


@contextmanager
def policy_server(answer, **metadata):
    """A server that answers each request by `answer(request)`: a map, text or bytes."""

    def handle(connection):
        connection.send(msgpack.packb({"policy": "by hand"} | metadata))
        for data in connection:
            reply = answer(msgpack.unpackb(data, object_hook=decoded))
            if isinstance(reply, dict):
                reply = msgpack.packb(reply, default=encoded)
            connection.send(reply)

    with serve(handle, "127.0.0.1", 0, compression=None) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        server.shutdown()
        thread.join(10)


def observation() -> Observation:
    return fakes.observation(4, seed=1)


def test_a_request_holds_the_newest_step_and_the_instruction():
    asked = []

    def answer(request):
        asked.append(request)
        return {
            "actions": np.arange(20 * 67, dtype=np.float32).reshape(20, 67),
            "server_timing": {},
        }

    with policy_server(answer) as url:
        policy = OpenPiPolicy(url, images={"observation/exterior_image_1_left": "camera_head"})
        assert policy.metadata == {"policy": "by hand"}
        policy.reset(START)
        seen = observation()
        actions = policy.act(seen)
        policy.close()
    (request,) = asked
    assert set(request) == {
        "observation/exterior_image_1_left", "observation/state", "observation/tactile", "prompt",
    }  # fmt: skip
    assert request["prompt"] == "stand it up"
    image = request["observation/exterior_image_1_left"]
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, seen.images["camera_head"][-1])
    np.testing.assert_array_equal(request["observation/state"], seen.action_reached[-1])
    np.testing.assert_array_equal(request["observation/tactile"], seen.tactile_kpa[-1])
    np.testing.assert_array_equal(actions, np.arange(16 * 67).reshape(16, 67))


def test_a_server_that_says_so_is_told_where_rollouts_begin():
    asked = []

    def answer(request):
        asked.append(request)
        return {"actions": np.zeros((4, 67))}

    with policy_server(answer, resets=True) as url:
        policy = OpenPiPolicy(url)
        for _ in range(2):
            policy.reset(START)
            policy.act(observation())
        policy.close()
    assert ["reset" in request for request in asked] == [True, False, True, False]


@pytest.mark.parametrize(
    ("reply", "error", "message"),
    [
        ("Traceback: CUDA out of memory", InvalidInputError, "CUDA out of memory"),
        ({"action": 1}, InvalidInputError, "no array `actions`"),
        ({"actions": [[0.0]]}, InvalidInputError, "got list"),
        ({"actions": np.zeros((16, 7))}, ShapeError, r"\[16, 7\], expected \[K, 67\]"),
        ({"actions": np.zeros(67)}, ShapeError, r"\[67\]"),
        (b"\xc1", InvalidInputError, "not msgpack"),
    ],
)
def test_answers_that_are_no_actions_name_the_server(reply, error, message):
    with policy_server(lambda _: reply) as url:
        policy = OpenPiPolicy(url)
        with pytest.raises(error, match=message):
            policy.act(observation())
        policy.close()


def test_a_server_that_is_gone_or_slow_is_unavailable():
    with pytest.raises(UnavailableError, match="does not answer"):
        OpenPiPolicy("ws://127.0.0.1:9")
    with policy_server(lambda _: time.sleep(1) or {}) as url:
        policy = OpenPiPolicy(url, timeout_s=0.1)
        with pytest.raises(UnavailableError, match=r"within 0.1 s"):
            policy.act(observation())
        policy.close()
    with pytest.raises(UnavailableError, match="does not answer"):
        policy.act(observation())


def test_a_late_answer_is_not_taken_for_the_next_one():
    """After a timeout or an error the policy connects anew: answers stay with their requests."""
    asked = []

    def answer(request):
        asked.append(request)
        if len(asked) == 1:
            time.sleep(0.5)
        if len(asked) == 3:
            return "Traceback: once"
        return {"actions": np.full((16, 67), float(len(asked)))}

    with policy_server(answer) as url:
        policy = OpenPiPolicy(url, timeout_s=0.3)
        with pytest.raises(UnavailableError):
            policy.act(observation())
        assert policy.act(observation())[0, 0] == 2.0
        with pytest.raises(InvalidInputError, match="once"):
            policy.act(observation())
        assert policy.act(observation())[0, 0] == 4.0
        policy.close()
        assert policy.act(observation())[0, 0] == 5.0
        policy.close()


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_answer_that_an_interrupt_left_behind_is_not_taken_for_the_next_one(error, monkeypatch):
    asked = []

    def answer(request):
        asked.append(request)
        return {"actions": np.full((16, 67), float(len(asked)))}

    with policy_server(answer) as url:
        policy = OpenPiPolicy(url)
        with monkeypatch.context() as patched:
            patched.setattr(ClientConnection, "recv", Mock(side_effect=error))
            with pytest.raises(error):
                policy.act(observation())
        actions = policy.act(observation())
        assert actions[0, 0] == len(asked)
        policy.close()


def test_a_silent_server_does_not_delay_policies_of_another():
    with socket.create_server(("127.0.0.1", 0)) as silent, ThreadPoolExecutor(1) as threads:
        address = f"ws://127.0.0.1:{silent.getsockname()[1]}"
        waiting = threads.submit(OpenPiPolicy, address, timeout_s=5.0)
        with silent.accept()[0]:
            with policy_server(linear) as url:
                OpenPiPolicy(url).close()
            assert not waiting.done()
        with pytest.raises(UnavailableError):
            waiting.result(20)


def test_the_last_policy_closes_the_connection_and_a_new_one_has_the_new_limit():
    limits = iter([8, 3])
    connections = []

    def handle(connection):
        connections.append(connection)
        connection.send(msgpack.packb({"max_batch": next(limits)}))
        for data in connection:
            reply = linear(msgpack.unpackb(data, object_hook=decoded))
            connection.send(msgpack.packb(reply, default=encoded))

    with serve(handle, "127.0.0.1", 0, compression=None) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        first, second = OpenPiPolicy(url), OpenPiPolicy(url)
        first.close()
        first.close()
        assert second.act(observation()).shape == (8, 67)
        assert len(connections) == 1
        second.close()
        assert second.act(observation()).shape == (8, 67)
        assert (len(connections), second._server.max_batch) == (2, 3)
        second.close()
        server.shutdown()


def test_it_is_a_policy_by_name():
    with policy_server(lambda _: {"actions": np.zeros((16, 67))}) as url:
        policy = PolicySource.parse("pi=dextouch.clients:OpenPiPolicy").load({"url": url})
        policy.reset(START)
        assert policy.act(observation()).shape == (16, 67)
        policy.close()
    with pytest.raises(InvalidInputError, match="expected at least 1"):
        OpenPiPolicy("ws://127.0.0.1:9", chunk_steps=0)


def linear(request):
    """Actions that depend on the whole request, as those of a network do."""
    state = request["observation/state"].astype(np.float32)
    touch = request["observation/tactile"].mean()
    return {"actions": np.tile(state, (8, 1)) + touch + len(request["prompt"])}


def acting_together(url, num_policies, num_chunks):
    """Actions of several policies in threads of their own, by policy and chunk."""

    begin = threading.Barrier(num_policies)

    def act(index):
        policy = OpenPiPolicy(url)
        begin.wait(20)
        policy.reset(PolicyStart("t", "x" * index, 0, fakes.anchor(), np.eye(3)))
        return [
            policy.act(fakes.observation(1, seed=100 * index + chunk))
            for chunk in range(num_chunks)
        ]

    with ThreadPoolExecutor(num_policies) as threads:
        return list(threads.map(act, range(num_policies)))


def test_requests_of_several_rollouts_go_together_where_the_server_says_so():
    sizes = []

    def answer(request):
        requests = request.get("batch", [request])
        sizes.append(len(requests))
        # The first one waits for all others.
        time.sleep(1.0 if len(sizes) == 1 else 0.01)
        answers = [linear(one) for one in requests]
        return {"batch": answers} if "batch" in request else answers[0]

    results, counts = {}, {}
    for max_batch in (1, 4):
        sizes.clear()
        with policy_server(answer, max_batch=max_batch) as url:
            results[max_batch] = acting_together(url, 6, 5)
        counts[max_batch] = list(sizes)
    assert set(counts[1]) == {1}
    assert max(counts[4]) == 4
    assert sum(counts[4]) == sum(counts[1]) == 30
    np.testing.assert_allclose(results[4], results[1], rtol=0, atol=1e-6)


def wait_for_others(policy, count):
    for _ in range(2000):
        if len(policy._server._waiting) == count:
            return
        time.sleep(0.01)
    raise AssertionError(f"{len(policy._server._waiting)} requests wait, expected {count}")


@contextmanager
def batch_of_three(answer):
    """Pending requests of four policies, of which three wait for the first and go together."""
    is_asked, may_answer = threading.Event(), threading.Event()

    def held(request):
        is_asked.set()
        assert may_answer.wait(20)
        return answer(request)

    with policy_server(held, max_batch=8) as url, ThreadPoolExecutor(4) as threads:
        policies = [OpenPiPolicy(url) for _ in range(4)]
        for index, one in enumerate(policies):
            one.reset(PolicyStart("t", "x" * index, 0, fakes.anchor(), np.eye(3)))
        pending = [threads.submit(policies[0].act, observation())]
        assert is_asked.wait(20)
        pending += [threads.submit(one.act, observation()) for one in policies[1:]]
        wait_for_others(policies[0], 3)
        may_answer.set()
        yield policies, pending


def refuses_two(request):
    """Reports an error about the request of the third policy, and about each batch with it."""
    requests = request.get("batch", [request])
    if any(one["prompt"] == "xx" for one in requests):
        return "no such prompt: xx"
    answers = [linear(one) for one in requests]
    return {"batch": answers} if "batch" in request else answers[0]


def answers_short(request):
    if "batch" in request:
        return {"batch": [linear(request["batch"][0])]}
    return linear(request) if request["prompt"] != "xx" else "no such prompt: xx"


@pytest.mark.parametrize("answer", [refuses_two, answers_short])
def test_a_request_that_is_refused_fails_alone(answer):
    with batch_of_three(answer) as (policies, pending):
        errors = [future.exception(20) for future in pending]
        assert [type(error) for error in errors] == [
            type(None), type(None), InvalidInputError, type(None),
        ]  # fmt: skip
        assert "no such prompt: xx" in str(errors[2])
        assert policies[0].act(observation()).shape == (8, 67)


def test_a_batch_that_gets_no_answer_fails_with_an_error_for_each_and_its_cause(monkeypatch):
    def unpacked(*_, **__):
        raise MemoryError("no room for 3 answers")

    def answer(request):
        if "batch" in request:
            monkeypatch.setattr("dextouch.clients.openpi.unpack_openpi", unpacked)
        return {"batch": []} if "batch" in request else linear(request)

    with batch_of_three(answer) as (_, pending):
        assert pending[0].exception(20) is None
        errors = [future.exception(20) for future in pending[1:]]
        assert [type(error) for error in errors] == [UnavailableError] * 3
        assert len({id(error) for error in errors}) == 3
        assert {type(error.__cause__) for error in errors} == {MemoryError}


@pytest.mark.parametrize("metadata", [{"max_batch": 8, "resets": True}, {"max_batch": True}, {}])
def test_requests_are_not_joined_where_the_server_does_not_say_so(metadata):
    def answer(request):
        time.sleep(0.01)
        assert "batch" not in request
        return {} if "reset" in request else linear(request)

    with policy_server(answer, **metadata) as url:
        assert len(acting_together(url, 3, 2)) == 3
