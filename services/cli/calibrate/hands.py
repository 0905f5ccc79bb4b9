"""Commands `dextouch station calibrate wrist` and `profile`: glove axes and hand sizes."""

import argparse

import numpy as np

from dextouch.errors import InvalidInputError
from services.alignment.retargeting.hand_profile import profile_name
from services.alignment.retargeting.wrist_frame import (
    calibrate_wrist,
    calibration_name,
    calibration_record,
    hand_axes_check,
)
from services.cli.calibrate.files import TakenStream, read_stream
from services.cli.calibrate.record import MATRICES_FILE, read_matrices, write_entry

FINGERS = ("thumb", "index", "middle", "ring", "little")


def measure_wrist(options: argparse.Namespace) -> dict[str, object]:
    """Measure the wrist frame in the axes of a glove's keypoints, from a take of the flat hand."""
    taken, side = _keypoints(options), options.side
    frame = calibrate_wrist(taken.batch.values, side, where=f"take {options.take!r}")
    name, sigma_deg = calibration_name(side), float(np.rad2deg(frame.sigma_rad))
    facts: dict[str, object] = {
        "side": side,
        "take": options.take,
        "sigma_deg": sigma_deg,
        "hand_size": frame.size,
        "misfit_mm": frame.misfit_m * 1e3,
        "num_samples": frame.num_samples,
    }
    record = calibration_record(frame, side)
    write_entry(options.to, name, {key: np.array(m) for key, m in record.items()}, facts)
    print(
        f"{name}: known to {sigma_deg:.1f}°; hand of size {frame.size:.2f} (1 is the mean adult), "
        f"nodes {facts['misfit_mm']:.1f} mm off the mean hand"
    )
    return facts


def measure_person(options: argparse.Namespace) -> dict[str, object]:
    """Measure bones and knuckles of the person who wears a glove, from a take of moving fingers.

    Keypoints are rotated to wrist axes by the calibration in `--to`, or else by the take's own.
    """
    from services.alignment.retargeting.hand_retargeter import HandRetargeter

    taken, side = _keypoints(options), options.side
    calibration = dict(taken.calibration)
    if (options.to / MATRICES_FILE).exists():
        calibration |= read_matrices(options.to)
    keypoints_m = hand_axes_check(taken.batch.values, side, calibration)
    profile = HandRetargeter(side).measure(keypoints_m)
    name = profile_name(side)
    bones_mm = dict(zip(FINGERS, (profile.bone_m * 1e3).round(1).tolist(), strict=True))
    facts: dict[str, object] = {
        "side": side,
        "take": options.take,
        "bones_mm": bones_mm,
        "is_rigid": profile.is_rigid,
        "num_samples": len(taken.batch),
    }
    write_entry(options.to, name, {name: profile.to_rows()}, facts)
    for finger, bones in bones_mm.items():
        print(f"  {finger:6} " + ", ".join(f"{bone:.1f}" for bone in bones) + " mm")
    print(f"{name}: bones from the knuckle outwards, from {facts['num_samples']} samples")
    return facts


def _keypoints(options: argparse.Namespace) -> TakenStream:
    taken = read_stream(options.take, f"keypoints_{options.side}", options.store)
    if not len(taken.batch):
        raise InvalidInputError(f"take {options.take!r}: keypoints_{options.side} has no sample")
    return taken
