"""Names and arguments that code outside this repository calls: they cannot be renamed."""

import importlib
import inspect

import numpy as np
import pytest

from dextouch.errors import ShapeError

# module: name → its arguments, in order; "*" begins those given by name only
PROMISED = {
    "dextouch.tactile.layout": {
        "NUM_RAW_TAXELS": None,
        "NUM_TAXELS": None,
        "select_taxels": "raw * side glove_model",
        "expand_taxels": "taxels * side glove_model",
        "split_pads": "taxels",
        "join_pads": "fingertips palm",
    },
    "dextouch.geometry.rotations": {"rotation_to_6d": "R", "rotation_from_6d": "columns"},
    "dextouch.hands.actions": {
        "ACTION_DIM": None,
        "relative_pose_9d": "Ts_world_x",
        "pack_action": "* wrist_left wrist_right joints_left_rad joints_right_rad camera_head",
        "unpack_action": "actions",
        "reanchor": "actions index",
        "poses_from_actions": "actions anchor",
    },
    "dextouch.hands.robot_hand": {
        "RobotHand": "side",
        "RobotHand.fingertips_m": "self joints_rad",
    },
    "dextouch.clocks": {
        "fit_clock": "t_device_ns t_host_ns",
        "ClockModel.to_host_ns": "self t_device_ns t_host_ns",
        "OnlineClock": "descriptor",
        "OnlineClock.update": "self * t_host_ns t_device_ns sequence",
    },
    "dextouch.episodes": {
        "EpisodeStore": "url",
        "EpisodeStore.writer": None,
        "EpisodeStore.open": "self episode_id",
        "EpisodeStore.recording": "self recording_id",
        "EpisodeReader.window": "self start num_steps * cameras grid",
    },
    "dextouch.metrics.policy": {
        "pearson": "* real imagined",
        "mmrv": "* real imagined ties",
    },
    "dextouch.metrics.tactile": dict.fromkeys(
        ("psnr", "ssim", "mse", "mae", "contact_mae", "contact_iou", "contact_f1"),
        "* predicted_kpa true_kpa",
    ),
    "dextouch.clients": {
        "RolloutClient": "url api_key",
        "RolloutClient.start": "self * world task init seed instruction action_kind",
        "Rollout.step": "self actions",
        "Policy.act": "self observation",
    },
    "dextouch.clients.gym_env": {"WorldEnv": None},
    "services.acquisition.drivers.tactile_glove": {
        "TactileGloveDecoder": "",
        "TactileGloveDecoder.feed": "self data",
    },
    "services.alignment.calibration.intrinsics": {
        "calibrate_camera": "images board",
        "CameraCalibration": None,
    },
    "services.alignment.calibration.hand_eye": {
        "solve_hand_eye": "Ts_world_tracker Ts_camera_board",
        "HandEyeResult": None,
        "DegenerateMotionError": None,
    },
    "services.alignment.calibration.time_offset": {
        "estimate_time_offset": "t_a_ns signal_a t_b_ns signal_b",
        "TimeOffset": None,
    },
    "services.alignment.retargeting.hand_retargeter": {
        "HandRetargeter": None,
        "HandRetargeter.retarget": "self keypoints_m valid",
        "RetargetResult": None,
    },
}
NAMES = [(module, name) for module, names in PROMISED.items() for name in names]


@pytest.mark.parametrize(("module", "name"), NAMES)
def test_name_and_arguments_are_as_promised(module, name):
    found = importlib.import_module(module)
    for part in name.split("."):
        found = getattr(found, part)
    arguments = PROMISED[module][name]
    if arguments is None:
        return
    in_order, _, by_name = arguments.partition("*")
    parameters = inspect.signature(found).parameters
    assert list(parameters)[: len(in_order.split())] == in_order.split()
    assert set(by_name.split()) <= set(parameters)
    needed = {key for key, value in parameters.items() if value.default is value.empty}
    assert needed <= set(arguments.split()), "an argument that nobody outside gives"


def test_tables_of_a_robot_hand():
    from dextouch.hands.robot_hand import RobotHand

    hand = RobotHand("left")
    assert len(hand.joint_names) == len(hand.lower_rad) == len(hand.upper_rad) == 20
    assert hand.fingertips_m(np.zeros((3, 20))).shape == (3, 5, 3)


def test_retargeting_leaves_out_nodes_that_are_not_valid():
    from services.alignment.retargeting.hand_retargeter import HandRetargeter
    from tests.unit.alignment.test_retargeting import bending, keypoints_of

    keypoints = keypoints_of(bending(6))
    valid = np.ones(keypoints.shape[:2], dtype=bool)
    valid[2:4, 9] = False
    wild = keypoints.copy()
    wild[2:4, 9] = 0.5
    missing = keypoints.copy()
    missing[2:4, 9] = np.nan
    masked = HandRetargeter("right").retarget(wild, valid)
    np.testing.assert_array_equal(
        masked.joints_rad, HandRetargeter("right").retarget(missing).joints_rad
    )
    with pytest.raises(ShapeError, match=r"valid: got float64 \[6, 25\], expected bool \[6, 25\]"):
        HandRetargeter("right").retarget(keypoints, valid.astype(float))
