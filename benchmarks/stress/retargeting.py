"""Stress of retargeting: singular fingers, broken samples, clocks that jump, 1000 live steps."""

from functools import cache, partial

import numpy as np

from benchmarks.simulated.hand_motions import Motion, fuzzed, motion_of, robot_motion
from benchmarks.stress.cells import Check, StageCells
from dextouch.hands.robot_hand import RobotHand
from services.alignment.retargeting import HandRetargeter, RetargetStatus
from services.twin.hands import twin_hand

STAGE = StageCells("retargeting")
_MAX_STEP_RAD = 0.16
# Of a call that comes late: the retargeter's default, 9.6 rad/s at 30 Hz.
_LATE_STEP_RAD = 0.32


@STAGE.cell("rotations", "straight fingers (a singular Jacobian), joints at both limits, one point")
def _rotations(check: Check) -> None:
    hand = RobotHand("right")
    postures = np.stack(
        [np.clip(0.0, hand.lower_rad, hand.upper_rad), hand.lower_rad, hand.upper_rad]
    )
    motion = motion_of(twin_hand("right", "robot"), np.repeat(postures, 4, axis=0))
    result = HandRetargeter("right").retarget(motion.keypoints_m)
    _bounded(check, result.joints_rad)
    straight = np.abs(result.joints_rad[:4] - motion.joints_rad[:4]).max()
    check.at_most("straight fingers off", straight, 0.02, "rad")
    flat = np.zeros((25, 3))
    result = HandRetargeter("right").step(flat)
    _bounded(check, result.joints_rad)
    check.true("all nodes in one point: nothing followed", not result.solved.any())


@STAGE.cell("clock", "times that stand, go back, are NaN; an hour between two samples; elapsed 0")
def _clock(check: Check) -> None:
    motion = _motion()
    retargeter = HandRetargeter("right")
    num = len(motion)
    for what, times in (
        ("stand", np.zeros(num)),
        ("go back", -np.arange(num) / 60.0),
        ("NaN", np.full(num, np.nan)),
    ):
        call = partial(retargeter.retarget, motion.keypoints_m, t_s=times)
        check.refused(f"times {what}", call)

    for elapsed_s in (0.0, -1.0, np.inf, np.nan):
        call = partial(retargeter.step, motion.keypoints_m[0], elapsed_s=elapsed_s)
        check.refused(f"elapsed {elapsed_s:g}", call)

    retargeter.reset()
    before = retargeter.step(motion.keypoints_m[0]).joints_rad
    after = retargeter.step(motion.keypoints_m[90], elapsed_s=3600.0).joints_rad
    check.at_most("step after an hour", np.abs(after - before).max(), _LATE_STEP_RAD + 1e-9, "rad")


@STAGE.cell(
    "non_finite", "NaN, infinity, 5e-324, outliers, swaps, dropouts, millimetres: 1500 samples"
)
def _non_finite(check: Check) -> None:
    faulty = fuzzed(_motion(1500), np.random.default_rng(5))
    retargeter = HandRetargeter("right")
    outputs = [retargeter.step(sample) for sample in faulty.keypoints_m]
    joints = np.concatenate([one.joints_rad for one in outputs])
    _bounded(check, joints)
    check.at_most(
        "largest step", np.abs(np.diff(joints, axis=0)).max(), _MAX_STEP_RAD + 1e-9, "rad"
    )
    lost = HandRetargeter("right").step(np.full((25, 3), np.nan))
    check.true("a hand that is lost says so", (lost.status == RetargetStatus.MISSING).all())
    check.refused("no sample ever", HandRetargeter("right").retarget, np.full((5, 25, 3), np.nan))
    check.refused("NaN joints at reset", retargeter.reset, np.full(20, np.nan))


@STAGE.cell("precision", "keypoints rounded to float32 and float16 (0.1 mm)")
def _precision(check: Check) -> None:
    motion = _motion()
    exact = HandRetargeter("right").retarget(motion.keypoints_m).joints_rad
    for name, bound in (("float32", 1e-3), ("float16", 0.15)):
        rounded = motion.keypoints_m.astype(name)
        got = HandRetargeter("right").retarget(rounded).joints_rad
        check.at_most(f"{name}: joints change", np.abs(got - exact).max(), bound, "rad")


@STAGE.cell("long_run", "1008 live samples: a motion of 2 s, again and again forth and back")
def _long_run(check: Check) -> None:
    motion = _motion()
    there_and_back = np.concatenate([motion.keypoints_m, motion.keypoints_m[::-1]])
    retargeter = HandRetargeter("right")
    samples = [there_and_back[k % len(there_and_back)] for k in range(1008)]
    joints = np.concatenate([retargeter.step(sample).joints_rad for sample in samples])
    _bounded(check, joints)
    period = len(there_and_back)
    rounds = joints[period : period * (1008 // period)].reshape(-1, period, 20)
    check.at_most("rounds differ", np.abs(rounds - rounds[0]).max(), 1e-3, "rad")


@STAGE.cell("batch", "120 samples one by one, live, and at once")
def _batch(check: Check) -> None:
    motion = _motion()
    retargeter = HandRetargeter("right")
    profile = retargeter.measure(motion.keypoints_m)
    live, whole = HandRetargeter("right", profile), HandRetargeter("right", profile)
    stepped = np.concatenate([live.step(sample).joints_rad for sample in motion.keypoints_m])
    together = whole.retarget(motion.keypoints_m).joints_rad
    check.at_most("joints differ", np.abs(stepped - together).max(), 1e-6, "rad")


STAGE.does_not_apply(
    one_axis="bones are measured, no mount: a hand that never moves is enough",
    touch="only keypoints come in; touch transfer is tested with the benchmark that has it",
    ends="no interval: times have no end that is special",
    device="numba on the host's memory",
)


@cache
def _motion(num_samples: int = 120) -> Motion:
    return robot_motion("right", num_samples, 3, natural=True)


def _bounded(check: Check, joints_rad: np.ndarray) -> None:
    hand = RobotHand("right")
    check.finite("joints", joints_rad)
    over = np.maximum(hand.lower_rad - joints_rad, joints_rad - hand.upper_rad).max()
    check.at_most("beyond joint limits", over, 1e-9, "rad")
