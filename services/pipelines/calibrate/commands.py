"""Commands `camera`, `robot-base`, `wrist`, `profile` and `latency` of `station calibrate`.

Intrinsics come from photos of a board, a robot's base from pairs of poses, the others from a take.
"""

import argparse

import numpy as np

from dextouch.clients import HttpLink
from dextouch.errors import InvalidInputError
from services.alignment.calibration.hand_eye import solve_robot_base
from services.alignment.calibration.tactile_tare import TactileCalibration
from services.alignment.calibration.time_offset import TimeOffset, estimate_tap_offset
from services.alignment.retargeting import wrist
from services.alignment.retargeting.hand_retargeter import profile_name
from services.alignment.station_calibration import camera_views
from services.alignment.station_calibration.record import (
    MATRICES_FILE,
    TakeStream,
    read_matrices,
    read_pairs,
    read_stream,
    write_entry,
    write_pose,
)

PAIRS_HELP = "JSON: [[T_world_tracker, T_base_effector], …], each 4x4, both of the same moment"
BASE_NAME = "T_world_base"
# Of a pose, in which a hand comes down on a table.
HEIGHT = 2
FINGERS = ("thumb", "index", "middle", "ring", "little")


def calibrate(options: argparse.Namespace) -> dict[str, object]:
    """Calibrate from the photos of a folder; coverage and advice are written in any case.

    With `--url` or `--watch` photos are collected first, until coverage is sufficient or Ctrl-C.
    """
    if options.watch and options.url is not None:
        raise InvalidInputError("got --watch and --url, expected one of the two")
    if not options.watch and options.url is None:
        return camera_views.calibrate_photos(options)
    session = camera_views.Session(options, None if options.url is None else options.photos)
    print("Ctrl-C ends the collection and calibrates with the photos so far")
    try:
        if options.url is None:
            session.collect(camera_views.folder_arrivals(options.photos))
        else:
            link = HttpLink(options.url, api_key=options.key)
            session.collect(camera_views.station_arrivals(link, options.camera))
    except KeyboardInterrupt:
        print(f"stopped with {len(session.views)} views")
    return camera_views.calibrate_photos(options)


def calibrate_base(options: argparse.Namespace) -> dict[str, object]:
    """Estimate a robot's base from pairs of poses of a tracker on the effector and the effector."""
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


def measure_wrist(options: argparse.Namespace) -> dict[str, object]:
    """Measure the wrist frame in the axes of a glove's keypoints, from a take of the flat hand."""
    taken, side = _keypoints(options), options.side
    frame = wrist.calibrate_wrist(taken.batch.values, side, where=f"take {options.take!r}")
    name, sigma_deg = wrist.calibration_name(side), float(np.rad2deg(frame.sigma_rad))
    facts: dict[str, object] = {
        "side": side,
        "take": options.take,
        "sigma_deg": sigma_deg,
        "hand_size": frame.size,
        "misfit_mm": frame.misfit_m * 1e3,
        "num_samples": frame.num_samples,
    }
    record = wrist.calibration_record(frame, side)
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
    keypoints_m = wrist.hand_axes_check(taken.batch.values, side, calibration)
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


def _keypoints(options: argparse.Namespace) -> TakeStream:
    taken = read_stream(options.take, f"keypoints_{options.side}", options.store)
    if not len(taken.batch):
        raise InvalidInputError(f"take {options.take!r}: keypoints_{options.side} has no sample")
    return taken


def measure_latency(options: argparse.Namespace) -> dict[str, object]:
    """Measure the delay between a glove and a tracker, in addition to calibrated latencies."""
    stream = read_stream(options.take, options.stream, options.store)
    reference = read_stream(options.take, options.reference, options.store)
    kinds = (reference.descriptor.kind, stream.descriptor.kind)
    if kinds == ("tactile", "pose"):
        found = _from_taps(reference, stream)
    elif kinds == ("pose", "tactile"):
        reverse = _from_taps(stream, reference)
        found = TimeOffset(-reverse.offset_ns, reverse.sigma_ns)
    else:
        raise InvalidInputError(
            f"latency of {options.stream!r} against {options.reference!r}: got streams of kind "
            f"{kinds[1]} and {kinds[0]}, expected a pose and a glove, which tap a table; shake "
            "trackers and cameras together and use `dextouch station calibrate time`"
        )
    # The offset is added to the stream's times: the latency is its negative.
    name, of_reference = f"{options.stream}_latency", f"{options.reference}_latency"
    latency_ns = stream.number(f"{name}_ns") - found.offset_ns
    sigma_ns = float(np.hypot(found.sigma_ns, reference.number(f"{of_reference}_sigma_ns")))
    facts: dict[str, object] = {
        "stream": options.stream,
        "reference": options.reference,
        "reference_latency_ms": reference.number(f"{of_reference}_ns") * 1e-6,
        "method": "taps",
        "take": options.take,
        "latency_ms": latency_ns * 1e-6,
        "sigma_ms": sigma_ns * 1e-6,
    }
    matrices = {f"{name}_ns": float(latency_ns), f"{name}_sigma_ns": sigma_ns}
    write_entry(options.to, name, matrices, facts)
    print(
        f"{name}: {facts['latency_ms']:.2f} ± {facts['sigma_ms']:.2f} ms by taps, where "
        f"{options.reference} has {facts['reference_latency_ms']:.2f} ms"
    )
    return facts


def _from_taps(glove: TakeStream, tracker: TakeStream) -> TimeOffset:
    stream = glove.descriptor
    t_ns, readings = glove.timed()
    if stream.side is None:
        raise InvalidInputError(f"stream {stream.name!r}: has no side")
    if stream.unit != "kPa":
        known = TactileCalibration.from_record(
            glove.calibration,
            stream.side,
            num_cells=stream.shape[0],
            stream=stream.name,
            layout=stream.layout,
        )
        readings = known.to_kpa(readings)
    t_pose_ns, poses = tracker.poses()
    peaks_kpa = np.where(np.isfinite(readings), readings, -np.inf).max(axis=1).astype(np.float64)
    seen = np.isfinite(peaks_kpa)
    return estimate_tap_offset(t_ns[seen], peaks_kpa[seen], t_pose_ns, poses[:, HEIGHT])
