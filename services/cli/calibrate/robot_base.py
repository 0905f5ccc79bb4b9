"""Command `dextouch station calibrate robot-base`: pose of a robot's base in the tracked world."""

import argparse

import numpy as np

from services.alignment.calibration.robot_base import solve_robot_base
from services.cli.calibrate.poses import pairs_of, read_json
from services.cli.calibrate.record import write_entry

BASE_NAME = "T_world_base"
PAIRS_HELP = "JSON: [[T_world_tracker, T_base_effector], …], each 4x4, both of the same moment"


def calibrate(options: argparse.Namespace) -> dict[str, object]:
    """Estimate the base from pairs of poses of a tracker on the effector and of the effector.

    Raises:
        DegenerateMotionError: the effector was rotated or moved too little; the message names the
            axes.
        InvalidInputError: too few pairs, or pairs that contradict each other.
        NotFoundError: no such file.
    """
    pairs = pairs_of(read_json(options.poses, PAIRS_HELP), options.poses, PAIRS_HELP)
    mount = np.eye(4) if options.same_frame else None
    result = solve_robot_base(pairs[:, 0], pairs[:, 1], T_effector_tracker=mount)
    left_out = list(result.left_out_views)
    for index in left_out:
        print(f"  pair {index} is far off: left out; did the robot stand still?")
    facts: dict[str, object] = {
        "num_pairs": len(pairs) - len(left_out),
        "sigma_rotation_deg": float(np.rad2deg(result.sigma_rotation_rad)),
        "sigma_translation_mm": result.sigma_translation_m * 1e3,
        "residual_rms_deg": float(np.rad2deg(result.rotation_rms_rad)),
        "residual_rms_mm": result.translation_rms_m * 1e3,
        "left_out": left_out,
        "T_effector_tracker": result.T_effector_tracker.tolist(),
    }
    matrices: dict[str, np.ndarray | float] = {
        BASE_NAME: result.T_world_base,
        f"{BASE_NAME}_sigma_rad": result.sigma_rotation_rad,
        f"{BASE_NAME}_sigma_m": result.sigma_translation_m,
    }
    write_entry(options.to, BASE_NAME, matrices, facts)
    print(
        f"{BASE_NAME}: known to {facts['sigma_rotation_deg']:.3f}° and "
        f"{facts['sigma_translation_mm']:.2f} mm from {facts['num_pairs']} pairs; they scatter by "
        f"{facts['residual_rms_deg']:.3f}° and {facts['residual_rms_mm']:.2f} mm RMS"
    )
    return facts
