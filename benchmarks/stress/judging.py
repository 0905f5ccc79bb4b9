"""Stress of the success classifier and the policies with unusual touch and poses."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

import services.evaluation
from benchmarks.stress.cells import Check, StageCells
from benchmarks.stress.worlds import NUM_CHUNKS, demonstration
from dextouch.errors import DexTouchError, NonFiniteError
from dextouch.hands.actions import JOINTS_LEFT, JOINTS_RIGHT, poses_from_actions
from dextouch.schemas import CHUNK_STEPS, Observation
from dextouch.streams import HEAD_CAMERA
from services.evaluation.endings import NUM_SEEN_STEPS, Ending, known_objects, object_features
from services.evaluation.policies.behaviour_cloning import KIND, BehaviourCloningPolicy
from services.evaluation.policies.open_loop import HoldPolicy
from services.evaluation.success_classifier import SuccessClassifier
from services.evaluation.trained_networks import Checkpoint, load_checkpoint

STAGE = StageCells("judging")
_PRETRAINED = Path(services.evaluation.__file__).parent / "pretrained"
# A chunk lasts about a second: no touch may send a hand farther.
_MAX_REACH_M, _MAX_JOINT_RAD = 0.6, 3.0
_PX = 64


@STAGE.cell(
    "rotations", "object poses with quaternions of 0, 1e-9 and -q; reached wrists turned by π"
)
def _rotations(check: Check) -> None:
    poses = np.zeros((3, 2, 7), dtype=np.float32)
    poses[..., 3] = 1.0
    same = object_features(poses)
    flipped = poses.copy()
    flipped[..., 3] = -1.0
    check.at_most("features of -q differ", np.abs(object_features(flipped) - same).max(), 1e-6)
    for length in (0.0, 1e-9):
        lost = poses.copy()
        lost[1, 0, 3:] = [length, 0, 0, 0]
        check.true("a lost quaternion is an absent object", not known_objects(lost)[0])
        check.finite("features", object_features(lost))
    observation = _seen()
    turned = observation.action_reached.copy()
    turned[:, 3:9] = [-1.0, 0, 0, 0, -1.0, 0]
    _command_is_bounded(check, _act(replace(observation, action_reached=turned)))
    lost_pose = observation.action_reached.copy()
    lost_pose[:, 3:9] = 0.0
    check.refused(
        "reached columns of zero", lambda: _act(replace(observation, action_reached=lost_pose))
    )


@STAGE.cell("non_finite", "NaN and infinity in touch, reached poses and object poses; 1e-40 kPa")
def _non_finite(check: Check) -> None:
    for bad in (np.nan, np.inf):
        tactile_kpa = _seen().tactile_kpa.copy()
        tactile_kpa[-1, 0, 3] = bad
        broken = replace(_seen(), tactile_kpa=tactile_kpa)
        check.refused(f"policy, touch {bad}", _act, broken, kind=NonFiniteError)
        ending = _ending(0.0)
        touch = ending.tactile_kpa.copy()
        touch[1, 1, 300] = bad
        broken_ending = replace(ending, tactile_kpa=touch)
        check.refused(f"probe, touch {bad}", _probe().verdict, broken_ending, kind=NonFiniteError)
        for column in (0, JOINTS_LEFT.start):
            reached = _seen().action_reached.copy()
            reached[-1, column] = bad
            broken = replace(_seen(), action_reached=reached)
            check.refused(f"policy, reached {bad}", _act, broken, kind=DexTouchError)
        poses = np.zeros((3, 2, 7), dtype=np.float32)
        poses[..., 3], poses[1, 0, 2] = 1.0, bad
        check.true("an object somewhere unknown is absent", not known_objects(poses)[0])
        check.finite("features", object_features(poses))
    probability = float(_probe().probabilities([_ending(1e-40)])[0])
    check.true("probability of 1e-40 kPa in 0 … 1", 0 <= probability <= 1)


@STAGE.cell("touch", "every taxel at 0, 650 and 99 999 kPa, and below zero")
def _touch(check: Check) -> None:
    for pressure_kpa in (0.0, -5.0, 650.0, 99_999.0):
        probability = float(_probe().probabilities([_ending(pressure_kpa)])[0])
        check.true("probabilities in 0 … 1", 0 <= probability <= 1)
        touch = np.full_like(_seen().tactile_kpa, pressure_kpa)
        _command_is_bounded(check, _act(replace(_seen(), tactile_kpa=touch)))
    what = "a saturated hand in an empty scene: probability of success"
    check.at_most(what, _probe().probabilities([_ending(99_999.0)])[0], 0.5)


@STAGE.cell("ends", "an ending of 2 steps; the policy at step 0 and long after its horizon")
def _ends(check: Check) -> None:
    check.refused("2 steps", Ending.of, _seen(2), "stand_bottle", imagined=False)
    check.refused("no ending", _probe().probabilities, [])
    for step in (0, 79, 80, 10**6):
        _command_is_bounded(check, _act(replace(_seen(), first_step=step)))
    at_horizon, after = (_act(replace(_seen(), first_step=step)) for step in (80, 10**9))
    check.equal("after the horizon time stands", at_horizon, after)


@STAGE.cell(
    "precision", "weights of probe and policy in bfloat16, as a smaller file would hold them"
)
def _precision(check: Check) -> None:
    found = load_checkpoint(_PRETRAINED / "behaviour_cloning.safetensors", kind=KIND)
    rounded = {name: tensor.bfloat16() for name, tensor in found.tensors.items()}
    policy = BehaviourCloningPolicy(Checkpoint(found.metadata, rounded))
    policy.reset(demonstration(_PX).policy_start)
    chunk = policy.act(_seen())
    _command_is_bounded(check, chunk)
    check.at_most("policy's command moves", np.abs(chunk - _act(_seen()))[:, :3].max(), 0.02, "m")
    check.true("answers float64", chunk.dtype == np.float64)


@STAGE.cell("long_run", "63 chunks of the cloned policy on images that never change, then of hold")
def _long_run(check: Check) -> None:
    policy = _policy()
    policy.reset(demonstration(_PX).policy_start)
    seen = _seen()
    for chunk in range(NUM_CHUNKS):
        actions = policy.act(seen)
        _command_is_bounded(check, actions)
        # Commands are reached exactly.
        seen = replace(
            _seen(CHUNK_STEPS), first_step=1 + CHUNK_STEPS * chunk, action_reached=actions
        )
    anchor = demonstration(_PX).policy_start.anchor
    R = poses_from_actions(actions, anchor).Ts_world_wrist_left[-1, :3, :3]
    check.at_most("RᵀR - 1", np.abs(R.T @ R - np.eye(3)).max(), 1e-9)
    hold = HoldPolicy()
    hold.reset(demonstration(_PX).policy_start)
    pose = _seen().action_reached[-1]
    for _ in range(NUM_CHUNKS):
        held = hold.act(replace(_seen(), action_reached=pose[None]))
        pose = held[-1]
    check.equal("hold holds", pose, _seen().action_reached[-1])


@STAGE.cell("batch", "eight endings at once and one by one, one of them at 650 kPa; 300 endings")
def _batch(check: Check) -> None:
    endings = [_ending(pressure) for pressure in (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 650.0)]
    together = _probe().probabilities(endings)
    alone = [_probe().probabilities([ending])[0] for ending in endings]
    check.at_most("probabilities differ", np.abs(together - alone).max(), 1e-5)
    many = _probe().probabilities(endings[:2] * 150).reshape(-1, 2)
    off = np.abs(many - together[:2]).max()
    check.at_most("probabilities in parts of 256 differ", off, 1e-5)


STAGE.does_not_apply(
    one_axis="nothing is estimated from motion; see hand-eye",
    clock="steps are counted, there is no clock",
    device="networks of 200 000 weights: they run on the CPU, nothing takes a device",
)


@cache
def _probe() -> SuccessClassifier:
    return SuccessClassifier.load(_PRETRAINED / "success_probe.safetensors")


@cache
def _policy() -> BehaviourCloningPolicy:
    return BehaviourCloningPolicy.load(_PRETRAINED / "behaviour_cloning.safetensors")


@cache
def _seen(num_steps: int = 1) -> Observation:
    """The first observation of a demonstration, repeated for some steps."""
    observation = demonstration(_PX).observation
    return replace(
        observation,
        images={HEAD_CAMERA: np.repeat(observation.images[HEAD_CAMERA], num_steps, axis=0)},
        tactile_kpa=np.repeat(observation.tactile_kpa, num_steps, axis=0),
        action_reached=np.repeat(observation.action_reached, num_steps, axis=0),
    )


def _ending(pressure_kpa: float) -> Ending:
    seen = _seen(NUM_SEEN_STEPS)
    touch = np.full_like(seen.tactile_kpa, pressure_kpa)
    return Ending.of(replace(seen, tactile_kpa=touch), "stand_bottle", imagined=False)


def _act(observation: Observation) -> np.ndarray:
    policy = _policy()
    policy.reset(demonstration(_PX).policy_start)
    return policy.act(observation)


def _command_is_bounded(check: Check, chunk: np.ndarray) -> None:
    check.finite("commands", chunk)
    reach_m = max(np.abs(chunk[:, :3]).max(), np.abs(chunk[:, 9:12]).max())
    check.at_most("wrist commanded from its start", reach_m, _MAX_REACH_M, "m")
    joint_rad = max(np.abs(chunk[:, JOINTS_LEFT]).max(), np.abs(chunk[:, JOINTS_RIGHT]).max())
    check.at_most("joint commanded", joint_rad, _MAX_JOINT_RAD, "rad")
