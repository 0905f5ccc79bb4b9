"""The visual servo: where it sees things, what it does by touch, and that it works in the twin."""

import numpy as np
import pytest

from dextouch.clients import Policy, PolicyStart
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.hands.actions import AnchorPoses
from dextouch.worlds.world import Observation, ReturnSelector, RolloutStart
from services.evaluation.policies.colour_servo import (
    BOTTLE,
    HANDLE,
    ColourServo,
    thing_pixels,
    thing_place_m,
)
from services.evaluation.policies.user_policies import PolicySource
from services.twin.settings import TwinSettings
from services.twin.world import TwinWorld

# A camera 1 m above the table that looks straight down: x right, y towards the viewer.
T_WORLD_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])
T_WORLD_CAMERA[2, 3] = 1.0
K = np.array([[100.0, 0.0, 32.0], [0.0, 100.0, 32.0], [0.0, 0.0, 1.0]])
YELLOW, GREEN, GREY = (200, 180, 40), (40, 124, 64), (150, 140, 128)


def picture(colour: tuple[int, int, int]) -> np.ndarray:
    image = np.full((64, 64, 3), GREY, np.uint8)
    image[20:22, 40:44] = colour
    return image


def test_a_colour_is_found_where_the_pinhole_camera_says():
    # Pixels 40 ... 44 and 20 ... 22 from edge to edge: the middle is (42, 21), 0.942 m away.
    found = thing_place_m(picture(YELLOW), HANDLE, T_WORLD_CAMERA, K)
    np.testing.assert_allclose(found, [0.0942, 0.10362, 0.058], atol=1e-9)
    assert thing_pixels(picture(YELLOW), HANDLE).sum() == 8
    assert thing_pixels(picture(GREEN), BOTTLE).sum() == 8


def test_what_is_not_there_is_not_found():
    assert thing_place_m(picture(GREEN), HANDLE, T_WORLD_CAMERA, K) is None
    assert thing_place_m(picture(GREY), BOTTLE, T_WORLD_CAMERA, K) is None
    upwards = np.diag([1.0, 1.0, 1.0, 1.0])
    assert thing_place_m(picture(YELLOW), HANDLE, upwards, K) is None


def begin(policy: ColourServo, task: str) -> None:
    anchor = AnchorPoses(np.eye(4), np.eye(4), T_WORLD_CAMERA)
    policy.reset(PolicyStart(task, "", 0, anchor, K))


def seen(image: np.ndarray, *, step: int = 0, pressure_kpa: float = 0.0) -> Observation:
    row = np.zeros((1, 67))
    row[0, [3, 7, 12, 16, 61, 65]] = 1.0
    touch = np.full((1, 2, 320), pressure_kpa, np.float32)
    return Observation(step, {"camera_head": image[None]}, touch, row, reached_is_measured=True)


def test_without_the_thing_it_stays():
    policy = ColourServo()
    begin(policy, "open_drawer")
    chunk = policy.act(seen(picture(GREY)))
    np.testing.assert_array_equal(chunk, np.tile(chunk[0], (16, 1)))
    np.testing.assert_array_equal(chunk[0], seen(picture(GREY)).action_reached[0])


def test_a_hand_that_feels_nothing_gives_up():
    ends = {}
    for pressure_kpa in (0.0, 10.0):
        policy = ColourServo()
        begin(policy, "open_drawer")
        for step in (0, 16):
            policy.act(seen(picture(YELLOW), step=step))
        chunk = policy.act(seen(picture(YELLOW), step=32, pressure_kpa=pressure_kpa))
        ends[pressure_kpa] = chunk[-1, 11]
    # Anchors are the world here; the one that feels stays low, the other is 14 cm above the thing.
    assert ends[0.0] - ends[10.0] == pytest.approx(0.14 + 0.018)


def test_what_it_was_not_made_for_is_refused():
    policy = ColourServo()
    assert isinstance(policy, Policy)
    with pytest.raises(InvalidInputError, match="before reset"):
        policy.act(seen(picture(YELLOW)))
    with pytest.raises(UnknownNameError, match="open_drawer"):
        begin(policy, "juggle")


@pytest.mark.long
@pytest.mark.parametrize("task", ["open_drawer", "stand_bottle"])
def test_it_succeeds_in_the_twin(task):
    twin = TwinWorld(TwinSettings(cameras=("camera_head",)))
    policy = PolicySource.parse("services.evaluation.policies.colour_servo:ColourServo").load({})
    successes = 0
    for seed in range(21000, 21003):
        begun = twin.reset(RolloutStart(task, seed, ""))
        policy.reset(PolicyStart(task, "", seed, begun.anchor, begun.K_head))
        state, observation = begun.state, begun.observation
        for _ in range(5):
            stepped = twin.step(
                state, policy.act(observation), seed=0, selector=ReturnSelector(steps="last")
            )
            state, observation = stepped.state, stepped.observation
        successes += bool(observation.success)
    assert successes >= 2
