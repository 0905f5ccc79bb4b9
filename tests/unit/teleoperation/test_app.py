"""The WebSocket of teleoperation on a real server, by a client that knows msgpack alone."""

import threading
import time
from contextlib import contextmanager

import httpx
import msgpack
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from dextouch.hands.robot_hand import RobotHand
from dextouch.serving.keys import ApiKey
from services.pipelines.servers import served
from services.pipelines.teleoperation.app import create_app
from services.pipelines.teleoperation.settings import CommandLimits, TeleoperationSettings
from tests.unit.teleoperation.hands import SIDE, sample

pytestmark = pytest.mark.long
KEY = "k3y-0f-the-c0ntr0ller-7"
OTHER = "an0ther-k3y-f0r-w0rlds-9"
NAMES = RobotHand(SIDE).joint_names
REST = dict.fromkeys(NAMES, 0.1)
LIMITS = CommandLimits(hold_after_s=0.3, relax_after_s=0.6)


@pytest.fixture(scope="module")
def url():
    settings = TeleoperationSettings(rate_hz=100, limits=LIMITS)
    with served({"teleoperation": create_app(settings)}) as urls:
        until_ready(urls["teleoperation"])
        yield urls["teleoperation"]


def until_ready(url):
    """Wait until the solver is compiled, a minute at most on a busy machine that never did."""
    for _ in range(1000):
        if httpx.get(f"{url}/readyz").status_code == 200:
            return
        time.sleep(0.2)
    pytest.fail("the service is not ready")


def message(fields, **arrays):
    """A message as docs/teleoperation.md describes it."""
    packed = {
        name: {"dtype": value.dtype.name, "shape": list(value.shape), "data": value.tobytes()}
        for name, value in arrays.items()
    }
    return msgpack.packb({"fields": fields, "arrays": packed})


def sample_message(index):
    given = sample(index)
    fields = {"sample": {"t_device_ns": given.t_device_ns}}
    return message(fields, keypoints_m=given.keypoints_m.astype(np.float32))


class Controller:
    """One controller: sends messages, and reads what comes."""

    def __init__(self, socket):
        self.socket = socket

    def receive(self):
        return msgpack.unpackb(self.socket.recv(timeout=20))["fields"]

    def start(self, joints=None):
        self.socket.send(message({"start": REST if joints is None else joints}))
        return self.receive()["hand"]

    def until(self, is_met, limit=1500):
        """Commands up to the first that meets a condition."""
        found = []
        while not found or not is_met(found[-1]):
            assert len(found) < limit
            found.append(self.receive())
        return found


@contextmanager
def controller(url, key=None, side=SIDE, **options):
    headers = {"Authorization": f"Bearer {key}"} if key else None
    address = f"{url.replace('http', 'ws')}/v1/teleop/{side}"
    with connect(
        address, compression=None, additional_headers=headers, proxy=None, **options
    ) as socket:
        yield Controller(socket)


def test_commands_come_at_the_rate_and_follow_hold_and_relax(url):
    with controller(url) as robot:
        hand = robot.start()
        assert hand["joint_names"] == list(NAMES)
        assert hand["rate_hz"] == 100
        first = robot.receive()
        assert (first["step"], first["status"], first["joints_rad"]) == (0, "not_ready", REST)
        # As fast as it takes: 120 samples, which are checked, and some to follow.
        for index in range(120):
            robot.socket.send(sample_message(index))
            robot.receive()
        for index in range(120, 150):
            robot.socket.send(sample_message(index))
            robot.receive()
        commands = robot.until(lambda command: command["status"] == "following")
        newest = robot.until(lambda command: command["latency_s"] is None)[-1]
        assert newest["t_device_ns"] in {sample(index).t_device_ns for index in range(120, 150)}
        assert set(newest["fingers"]) == {"thumb", "index", "middle", "ring", "little"}
        assert {finger["status"] for finger in newest["fingers"].values()} <= {
            "solved",
            "reacquired",
        }
        commands = robot.until(lambda command: command["status"] == "relaxing")
        statuses = [command["status"] for command in commands]
        assert "holding" in statuses
        began = time.monotonic()
        steps = [robot.receive()["step"] for _ in range(100)]
        assert steps == list(range(steps[0], steps[0] + 100))
        # A busy machine may be late, never early.
        assert 0.9 < time.monotonic() - began < 10


def test_a_stop_is_answered_until_the_next_start(url):
    with controller(url) as robot:
        robot.start()
        robot.socket.send(message({"stop": True}))
        robot.until(lambda command: command["status"] == "stopped")
        assert robot.receive()["status"] == "stopped"
        robot.socket.send(message({"start": REST | {NAMES[0]: 0.2}}))
        command = robot.until(lambda command: command["status"] == "not_ready")[-1]
        assert command["joints_rad"][NAMES[0]] == 0.2


def test_another_program_can_stop_a_hand(url):
    stop = f"{url}/v1/teleop/right/stop"
    assert httpx.post(f"{url}/v1/teleop/left/stop").status_code == 404
    with controller(url) as robot:
        robot.start()
        assert httpx.post(stop).status_code == 204
        robot.until(lambda command: command["status"] == "stopped")
        assert robot.receive()["status"] == "stopped"


def test_a_second_controller_is_refused_until_the_first_is_gone(url):
    with controller(url) as robot:
        robot.start()
        with controller(url) as second, pytest.raises(ConnectionClosed) as closed:
            second.receive()
        assert closed.value.rcvd.code == 1008
        assert "the right hand is controlled by 'loopback'" in closed.value.rcvd.reason
        with controller(url, side="left") as left:
            left.socket.send(message({"start": {n.replace("r_", "l_", 1): 0.0 for n in NAMES}}))
            assert left.receive()["hand"]["name"] == "Wuji Hand 2 left"
        assert robot.receive()["status"] == "not_ready"
    deadline_s = time.monotonic() + 10
    while time.monotonic() < deadline_s:
        try:
            with controller(url) as again:
                assert again.start()
            break
        except ConnectionClosed:
            time.sleep(0.05)
    else:
        pytest.fail("the hand is still controlled")


@pytest.mark.parametrize(
    ("given", "error"),
    [
        (message({}), "got the fields none, expected one of start, sample, stop"),
        (message({"stop": True, "more": 1}), "got the fields more, stop"),
        (b"\xc1", "msgpack"),
        ("text", "got text"),
        (message({"sample": {}}), "got t_device_ns None"),
        (message({"sample": {"t_device_ns": -1}}), "got t_device_ns -1"),
        (message({"sample": {"t_device_ns": 1}}), "got keypoints_m none"),
        (
            message({"sample": {"t_device_ns": 1}}, keypoints_m=np.zeros((21, 3))),
            r"got keypoints_m float64 [21, 3]",
        ),
        (message({"start": {}}), "joints missing or unknown: r_index_finger_dip"),
        (message({"start": REST | {"r_thumb_ip": "far"}}), "expected a map of joint names"),
        (message({"start": {b"r_thumb_ip": 0.0}}), "expected a map of joint names"),
        (message({"start": REST | {"r_thumb_ip": 3.0}}), "joint r_thumb_ip: got 3.000 rad"),
    ],
)
def test_a_message_that_is_none_is_told_in_a_command_and_changes_nothing(url, given, error):
    with controller(url) as robot:
        robot.start()
        robot.socket.send(given)
        told = robot.until(lambda command: command["error"] is not None)[-1]
        assert error in told["error"]
        after = robot.receive()
        assert (after["error"], after["joints_rad"]) == (None, REST)
        assert after["step"] == told["step"] + 1


@pytest.mark.parametrize(
    "given",
    [
        sample_message(0),
        message({"start": {"r_thumb_ip": 0.0}}),
        message({"start": REST | {"親指" * 20: 0.0}}),
        "text",
    ],
    ids=["sample", "some joints", "other letters", "text"],
)
def test_a_hand_that_was_not_started_gets_no_command(url, given):
    with controller(url) as robot:
        robot.socket.send(given)
        with pytest.raises(ConnectionClosed) as closed:
            robot.receive()
    assert closed.value.rcvd.code == 1008
    assert closed.value.rcvd.reason


def test_another_hand_is_told_why_it_is_not_followed(url):
    with controller(url) as robot:
        robot.start()
        for index in range(125):
            fields = {"sample": {"t_device_ns": sample(index).t_device_ns}}
            robot.socket.send(message(fields, keypoints_m=sample(index).keypoints_m * 1e3))
        told = robot.until(lambda command: command["error"] is not None)[-1]
        assert "these look like millimetres" in told["error"]
        assert told["status"] == "not_ready"


def test_nobody_controls_a_hand_before_the_solver_is_compiled(monkeypatch):
    compiled = threading.Event()
    monkeypatch.setattr("services.pipelines.teleoperation.app.warm_up", compiled.wait)
    with served({"teleoperation": create_app(TeleoperationSettings())}) as urls:
        url = urls["teleoperation"]
        assert httpx.get(f"{url}/readyz").json()["waiting_for"] == ["solver"]
        with controller(url) as robot, pytest.raises(ConnectionClosed) as closed:
            robot.receive()
        assert "the solver is being compiled" in closed.value.rcvd.reason
        compiled.set()
        until_ready(url)


def test_keys_need_the_scope_teleop():
    keys = (
        ApiKey(name="robot", key=KEY, scopes=("teleop",)),
        ApiKey(name="policy", key=OTHER, scopes=("rollout",)),
    )
    app = create_app(TeleoperationSettings(api_keys=keys))
    with served({"teleoperation": app}) as urls:
        url = urls["teleoperation"]
        until_ready(url)
        with controller(url, key=KEY) as robot:
            assert robot.start()["name"] == "Wuji Hand 2 right"
        for key in (None, OTHER):
            with pytest.raises(InvalidStatus) as refused, controller(url, key=key):
                pass
            assert refused.value.response.status_code == 403


def test_metrics_count_commands_latencies_and_refused_samples(url):
    with controller(url) as robot:
        robot.start()
        for index in range(200):
            robot.socket.send(sample_message(index))
            robot.receive()
        robot.socket.send(sample_message(3))
        robot.until(lambda command: command["refused"].get("time"))
        robot.receive()
        text = httpx.get(f"{url}/metrics").text
    found = dict(line.rsplit(" ", 1) for line in text.splitlines() if line[0] != "#")
    name = "dextouch_teleoperation"
    assert float(found[f'{name}_latency_seconds_count{{side="right"}}']) > 10
    assert float(found[f'{name}_commands_total{{side="right",status="following"}}']) > 10
    assert float(found[f'{name}_refused_samples_total{{reason="time",side="right"}}']) >= 1
