"""Commands `camera` and `robot-base` of `dextouch station calibrate`.

Intrinsics come from photos of a board, which lie in a folder or are collected first, from a watched
folder or a running station; a robot's base comes from pairs of poses.
"""

import argparse

import numpy as np

from dextouch.clients import HttpLink
from dextouch.errors import InvalidInputError
from services.alignment.calibration.hand_eye import solve_robot_base
from services.alignment.station_calibration.camera_views import (
    Session,
    calibrate_photos,
    folder_arrivals,
    station_arrivals,
)
from services.alignment.station_calibration.record import read_pairs, write_pose

PAIRS_HELP = "JSON: [[T_world_tracker, T_base_effector], …], each 4x4, both of the same moment"
BASE_NAME = "T_world_base"


def calibrate(options: argparse.Namespace) -> dict[str, object]:
    """Calibrate from the photos of a folder; coverage and advice are written in any case.

    With `--url` or `--watch` photos are collected first.
    """
    if options.watch and options.url is not None:
        raise InvalidInputError("got --watch and --url, expected one of the two")
    if options.watch or options.url is not None:
        _collect(options)
    return calibrate_photos(options)


def _collect(options: argparse.Namespace) -> None:
    """Collect until coverage is sufficient, or Ctrl-C."""
    session = Session(options, None if options.url is None else options.photos)
    print("Ctrl-C ends the collection and calibrates with the photos so far")
    try:
        if options.url is None:
            session.collect(folder_arrivals(options.photos))
            return
        link = HttpLink(options.url, api_key=options.key)
        session.collect(station_arrivals(link, options.camera))
    except KeyboardInterrupt:
        print(f"stopped with {len(session.views)} views")


def calibrate_base(options: argparse.Namespace) -> dict[str, object]:
    """Estimate a robot's base from pairs of poses of a tracker on the effector and the effector.

    Raises:
        DegenerateMotionError: the effector was rotated or moved too little; the message names the
            axes.
        InvalidInputError: too few pairs, or pairs that contradict each other.
    """
    pairs = read_pairs(options.poses, PAIRS_HELP)
    mount = np.eye(4) if options.same_frame else None
    result = solve_robot_base(pairs[:, 0], pairs[:, 1], T_effector_tracker=mount)
    left_out = list(result.left_out_views)
    for index in left_out:
        print(f"  pair {index} is far off: left out; did the robot stand still?")
    rms_deg, rms_mm = np.rad2deg(result.rotation_rms_rad), result.translation_rms_m * 1e3
    facts: dict[str, object] = {
        "num_pairs": len(pairs) - len(left_out),
        "residual_rms_deg": float(rms_deg),
        "residual_rms_mm": rms_mm,
        "left_out": left_out,
        "T_effector_tracker": result.T_effector_tracker.tolist(),
    }
    sigma = (result.sigma_rotation_rad, result.sigma_translation_m)
    known = write_pose(options.to, BASE_NAME, result.T_world_base, sigma, facts)
    print(
        f"{known} from {facts['num_pairs']} pairs; they scatter by {rms_deg:.3f}° and "
        f"{rms_mm:.2f} mm RMS"
    )
    return facts
