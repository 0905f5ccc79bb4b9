"""Commands `wrist`, `profile` and `latency` of `dextouch station calibrate`, each from one take.

The latency of a tracker is relative to a glove, or the other way round: a hand taps a table.
"""

import argparse

import numpy as np

from dextouch.errors import InvalidInputError
from services.alignment.calibration.tactile_tare import TactileCalibration
from services.alignment.calibration.time_offset import TimeOffset, estimate_tap_offset
from services.alignment.retargeting.hand_retargeter import profile_name
from services.alignment.retargeting.wrist import (
    calibrate_wrist,
    calibration_name,
    calibration_record,
    hand_axes_check,
)
from services.alignment.station_calibration.record import (
    MATRICES_FILE,
    TakeStream,
    read_matrices,
    read_stream,
    write_entry,
)

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


def _keypoints(options: argparse.Namespace) -> TakeStream:
    taken = read_stream(options.take, f"keypoints_{options.side}", options.store)
    if not len(taken.batch):
        raise InvalidInputError(f"take {options.take!r}: keypoints_{options.side} has no sample")
    return taken


# Of a pose, in which a hand comes down on a table.
HEIGHT = 2


def measure_latency(options: argparse.Namespace) -> dict[str, object]:
    """Measure the delay between a glove and a tracker, in addition to calibrated latencies.

    Raises:
        DegenerateMotionError: no taps.
        InvalidInputError: not a glove and a tracker.
    """
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
    pressure_kpa = readings.astype(np.float64)
    whole = np.isfinite(pressure_kpa).all(axis=1)
    t_pose_ns, poses = tracker.poses()
    peaks_kpa = pressure_kpa[whole].max(axis=1)
    return estimate_tap_offset(t_ns[whole], peaks_kpa, t_pose_ns, poses[:, HEIGHT])
