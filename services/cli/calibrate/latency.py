"""Command `dextouch station calibrate latency`: path delay of a stream relative to another one.

Either two pose streams record the same brisk motion (trackers held together), or a glove and a
tracker record a hand that taps a table.
"""

import argparse

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.errors import InvalidInputError
from dextouch.geometry import transform_from_pose
from dextouch.geometry.rotations import vector_from_rotation
from services.alignment.calibration.motion import DegenerateMotionError
from services.alignment.calibration.tactile_baseline import TactileCalibration
from services.alignment.calibration.time_offset import (
    TimeOffset,
    estimate_tap_offset,
    estimate_time_offset,
)
from services.cli.calibrate.files import TakenStream, read_stream
from services.cli.calibrate.record import write_entry

# Quaternion norm below which a pose counts as lost, since trackers then send zeros.
MIN_NORM = 0.5
HEIGHT = 2


def calibrate(options: argparse.Namespace) -> dict[str, object]:
    """Measure the delay of one stream relative to another, in addition to calibrated latencies.

    Raises:
        DegenerateMotionError: too little, too slow or too regular motion, or no taps.
        InvalidInputError: two streams that share no motion.
    """
    stream = read_stream(options.take, options.stream, options.store)
    reference = read_stream(options.take, options.reference, options.store)
    kinds, method = (reference.descriptor.kind, stream.descriptor.kind), "taps"
    if kinds == ("pose", "pose"):
        found, method = _from_motion(reference, stream), "motion"
    elif kinds == ("tactile", "pose"):
        found = _from_taps(reference, stream)
    elif kinds == ("pose", "tactile"):
        reverse = _from_taps(stream, reference)
        found = TimeOffset(-reverse.offset_ns, reverse.sigma_ns)
    else:
        raise InvalidInputError(
            f"latency of {options.stream!r} against {options.reference!r}: got streams of kind "
            f"{kinds[1]} and {kinds[0]}, expected two poses, or a pose and a glove"
        )
    # The offset is added to the stream's times: the latency is its negative.
    name, of_reference = f"{options.stream}_latency", f"{options.reference}_latency"
    latency_ns = stream.number(f"{name}_ns") - found.offset_ns
    sigma_ns = float(np.hypot(found.sigma_ns, reference.number(f"{of_reference}_sigma_ns")))
    facts: dict[str, object] = {
        "stream": options.stream,
        "reference": options.reference,
        "reference_latency_ms": reference.number(f"{of_reference}_ns") * 1e-6,
        "method": method,
        "take": options.take,
        "latency_ms": latency_ns * 1e-6,
        "sigma_ms": sigma_ns * 1e-6,
    }
    matrices = {f"{name}_ns": float(latency_ns), f"{name}_sigma_ns": sigma_ns}
    write_entry(options.to, name, matrices, facts)
    print(
        f"{name}: {facts['latency_ms']:.2f} ± {facts['sigma_ms']:.2f} ms by {method}, where "
        f"{options.reference} has {facts['reference_latency_ms']:.2f} ms"
    )
    return facts


def _from_motion(a: TakenStream, b: TakenStream) -> TimeOffset:
    (t_a_ns, a_rad_s), (t_b_ns, b_rad_s) = _angular_velocity(a), _angular_velocity(b)
    try:
        return estimate_time_offset(t_a_ns, a_rad_s, t_b_ns, b_rad_s)
    except DegenerateMotionError:
        # The worlds of two tracking systems may be rotated to each other, but speeds are equal.
        speeds = np.linalg.norm(a_rad_s, axis=1), np.linalg.norm(b_rad_s, axis=1)
        return estimate_time_offset(t_a_ns, speeds[0], t_b_ns, speeds[1])


def _from_taps(glove: TakenStream, tracker: TakenStream) -> TimeOffset:
    stream = glove.descriptor
    t_ns, readings = glove.timed()
    if stream.side is None:
        raise InvalidInputError(f"stream {stream.name!r}: has no side")
    if stream.unit != "kPa":
        known = TactileCalibration.from_record(
            glove.calibration, stream.side, num_cells=stream.shape[0], stream=stream.name
        )
        readings = known.to_kpa(readings)
    pressure_kpa = readings.astype(np.float64)
    whole = np.isfinite(pressure_kpa).all(axis=1)
    t_pose_ns, poses = _poses(tracker)
    peaks_kpa = pressure_kpa[whole].max(axis=1)
    return estimate_tap_offset(t_ns[whole], peaks_kpa, t_pose_ns, poses[:, HEIGHT])


def _angular_velocity(
    stream: TakenStream,
) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    """Angular velocity in the world (rad/s), which is the same for all parts of a rigid body."""
    t_ns, poses = _poses(stream)
    Rs = transform_from_pose(poses)[:, :3, :3]
    turns_rad = vector_from_rotation(Rs[1:] @ np.swapaxes(Rs[:-1], -1, -2))
    steps_ns = np.diff(t_ns)
    return t_ns[:-1] + steps_ns // 2, turns_rad / (steps_ns[:, None] * 1e-9)


def _poses(stream: TakenStream) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 7"]]:
    """Times and poses of valid tracking."""
    t_ns, values = stream.timed()
    poses = values.astype(np.float64)
    seen = np.isfinite(poses).all(axis=1) & (np.linalg.norm(poses[:, 3:], axis=1) > MIN_NORM)
    if np.count_nonzero(seen) < 2:
        raise InvalidInputError(
            f"take {stream.take!r}: {stream.descriptor.name} has {np.count_nonzero(seen)} valid "
            "poses, expected two seconds of them; was the tracker visible?"
        )
    return t_ns[seen], poses[seen]
