"""Mistakes: each kind changes what it says, grows with its strength, and repeats."""

from dataclasses import replace

import numpy as np
import pytest

from dextouch.errors import InvalidInputError, UnknownNameError
from services.twin.demonstrators import MotionScene
from services.twin.mistakes import DEVELOPMENT, HELD_OUT, KINDS, TRAINING, Mistake, with_mistakes
from services.twin.settings import TwinSettings
from services.twin.stage import Stage

SEED = 5


@pytest.fixture(scope="module")
def stage():
    return Stage("insert_peg", "robot", TwinSettings(cameras=()))


@pytest.fixture(scope="module")
def plan(stage):
    """A plan within the limits of the joints, which scripts leave by a degree when they press."""
    plan, hands = stage.plan(SEED), stage.simulation.scene.hands
    inside = {
        name: np.clip(
            getattr(plan.commands, name), hand.kinematics.lower_rad, hand.kinematics.upper_rad
        )
        for name, hand in zip(("joints_left_rad", "joints_right_rad"), hands, strict=True)
    }
    return replace(plan, commands=replace(plan.commands, **inside))


def changed(plan, *mistakes, seed=SEED):
    return with_mistakes(plan.commands, mistakes, MotionScene("robot", plan.object_poses), seed)


def apart(one, other):
    """Largest distance (m) of wrists, turn (rad) of wrists, and turn (rad) of joints."""
    Ts, others = (
        np.stack([each.Ts_world_wrist_left, each.Ts_world_wrist_right]) for each in (one, other)
    )
    # |R - R'| = sqrt(8) sin(angle / 2)
    chords = np.linalg.norm(Ts[..., :3, :3] - others[..., :3, :3], axis=(-1, -2)) / 8**0.5
    turn = 2 * np.arcsin(chords.max().clip(0, 1))
    joints = [
        np.abs(getattr(one, name) - getattr(other, name)).max()
        for name in ("joints_left_rad", "joints_right_rad")
    ]
    away = np.linalg.norm(Ts[..., :3, 3] - others[..., :3, 3], axis=-1)
    return away.max(), turn, max(joints)


def test_no_kind_is_in_two_sets():
    assert len(TRAINING) + len(DEVELOPMENT) + len(HELD_OUT) == len(KINDS)
    assert min(map(len, (TRAINING, DEVELOPMENT, HELD_OUT))) >= 5


@pytest.mark.parametrize("kind", KINDS)
def test_a_mistake_grows_with_its_strength_keeps_the_start_and_repeats(plan, kind):
    sizes = []
    for strength in (0.1, 0.5, 1.0):
        made = changed(plan, Mistake(kind, strength))
        again = changed(plan, Mistake(kind, strength))
        assert apart(made, again) == (0, 0, 0)
        for name in ("Ts_world_wrist_left", "Ts_world_wrist_right", "joints_right_rad"):
            np.testing.assert_array_equal(getattr(made, name)[0], getattr(plan.commands, name)[0])
        np.testing.assert_array_equal(made.Ts_world_camera_head, plan.commands.Ts_world_camera_head)
        sizes.append(max(apart(made, plan.commands)))
    assert 0 < sizes[0] <= sizes[1] + 1e-6 <= sizes[2] + 2e-6
    assert sizes[2] > 0.004


@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"quantized"}))
def test_without_strength_there_is_no_mistake(plan, kind):
    if kind == "regrasp":
        pytest.skip("its strength is the time that fingers stay open")
    assert max(apart(changed(plan, Mistake(kind, 0.0)), plan.commands)) < 1e-5


def test_fingers_stay_within_their_limits(stage, plan):
    for kind in ("opening", "grip"):
        for seed in range(6):
            made = changed(plan, Mistake(kind, 1.0), seed=seed)
            for q, hand in zip(
                (made.joints_left_rad, made.joints_right_rad), stage.simulation.scene.hands,
                strict=True,
            ):  # fmt: skip
                assert (q[1:] >= hand.kinematics.lower_rad - 1e-12).all()
                assert (q[1:] <= hand.kinematics.upper_rad + 1e-12).all()


def test_known_kinds_do_what_their_names_say(plan):
    away, turn, joints = apart(changed(plan, Mistake("height", 0.4)), plan.commands)
    assert (away, joints) == (pytest.approx(0.010), 0)
    assert turn < 1e-6
    away, turn, joints = apart(changed(plan, Mistake("tilt", 0.5)), plan.commands)
    assert turn == pytest.approx(np.deg2rad(15), rel=0.01)
    assert joints == 0
    # The fingertips stay: the wrist goes around them.
    assert 0.01 < away < 0.08
    away, turn, joints = apart(changed(plan, Mistake("finger_time", 0.5)), plan.commands)
    assert max(away, turn) < 1e-5
    assert joints > 0.1


def test_mistakes_follow_one_another(plan):
    both = changed(plan, Mistake("height", 0.4), Mistake("finger_time", 0.5))
    away, _, joints = apart(both, plan.commands)
    assert away == pytest.approx(0.010)
    assert joints > 0.1


def test_the_text_of_a_mistake():
    assert Mistake.parse("tilt=0.25") == Mistake("tilt", 0.25)
    assert Mistake.parse(str(Mistake("height", 0.123))) == Mistake("height", 0.123)
    with pytest.raises(UnknownNameError, match="tilt"):
        Mistake.parse("lean=0.2")
    for text in ("tilt", "tilt=-1", "tilt=nan", "tilt=2", "tilt=0.1234567"):
        with pytest.raises(InvalidInputError):
            Mistake.parse(text)
