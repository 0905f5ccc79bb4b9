"""Command `dextouch station calibrate time`: path delays of everything that was shaken together."""

import argparse
from collections.abc import Iterator
from typing import Final

import numpy as np

from dextouch.episodes import RecordingReader
from dextouch.episodes.spool import SpoolReader
from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.geometry import distortion_of, transform_from_pose
from dextouch.hands import PALM_NODES
from dextouch.images import decode_jpeg
from dextouch.schemas import Matrix
from dextouch.streams import COMMANDED, H264_UNIT, JPEG_UNIT, StreamDescriptor
from services.alignment.calibration.common_motion import (
    SharedTimes,
    Turning,
    shared_times,
    turning_of_images,
    turning_of_points,
    turning_of_rotations,
)
from services.alignment.station_calibration.record import (
    MATRICES_FILE,
    Say,
    TakeStream,
    number_of,
    open_take,
    read_matrices,
    write_entry,
)
from services.alignment.synchronization.recorded_streams import check_lens

# Images that are decoded at once, so that ten seconds of a camera need no gigabyte.
_IMAGES_AT_ONCE: Final = 32
# Chosen: slower cameras lose the corners between two images of a brisk turn.
MIN_CAMERA_HZ: Final = 15.0


def measure_times(options: argparse.Namespace, *, say: Say = print) -> dict[str, object]:
    """Measure the delays of all streams of a take that turned together, after a reference.

    Raises DegenerateMotionError: unsuitable motion; InvalidInputError: fewer than two streams.
    """
    where = f"take {options.take!r}"
    reader = open_take(options.take, options.store)
    cameras = dict(reader.attributes.calibration)
    if (options.to / MATRICES_FILE).exists():
        cameras |= read_matrices(options.to)
    selected = None
    if options.streams is not None:
        selected = [name.strip() for name in options.streams.split(",")]
    unknown = sorted(set(selected or ()) - set(reader.streams))
    if unknown:
        raise NotFoundError(f"{where}: has no {', '.join(unknown)}, only {sorted(reader.streams)}")
    turnings: dict[str, Turning] = {}
    left_out: dict[str, str] = {}
    for name in reader.streams:
        if selected is not None and name not in selected:
            continue
        found = _turning(reader, name, cameras, where)
        if isinstance(found, str):
            left_out[name] = found
        else:
            turnings[name] = found
    if len(turnings) < 2:
        raise InvalidInputError(
            f"{where}: {len(turnings)} of its streams show how they turned, expected two at least"
            + "".join(f"; {name} {reason}" for name, reason in left_out.items())
        )
    if options.reference in left_out:
        raise InvalidInputError(f"{options.reference} {left_out[options.reference]}")
    # By default the stream whose delay is known best; without any the first one, with a delay of 0.
    reference = options.reference or min(
        turnings, key=lambda name: number_of(cameras, f"{name}_latency_sigma_ns", np.inf)
    )
    subtracted = dict(reader.attributes.calibration)
    return _written(
        options, shared_times(turnings, reference), (subtracted, cameras), left_out, say
    )


def _turning(
    reader: SpoolReader | RecordingReader, name: str, cameras: dict[str, Matrix], where: str
) -> Turning | str:
    """How a stream turned, or why it does not show that; refuses another camera's matrix."""
    descriptor = reader.streams[name]
    if descriptor.kind == "image":
        return _camera_turning(reader, name, cameras, where)
    if (reason := _unsuitable(descriptor)) is not None:
        return reason
    stream = TakeStream(where, descriptor, reader.read(name), reader.attributes.calibration)
    if descriptor.kind == "pose":
        try:
            t_ns, poses = stream.poses()
        except InvalidInputError as error:
            # Of all that is recorded a tracker may be switched off.
            return f"is not used: {error.message}"
        return turning_of_rotations(t_ns, transform_from_pose(poses)[:, :3, :3])
    t_ns, points_m = stream.timed()
    palm_m = points_m[:, PALM_NODES].astype(np.float64)
    whole = np.isfinite(palm_m).all(axis=(1, 2))
    if not whole.any():
        return "has no sample in which the whole palm is seen"
    return turning_of_points(t_ns[whole], palm_m[whole])


def _unsuitable(descriptor: StreamDescriptor) -> str | None:
    if descriptor.kind == "pose" and not descriptor.name.endswith(COMMANDED):
        is_one = descriptor.shape == (7,)
        return None if is_one else f"has poses of shape {descriptor.shape}"
    if descriptor.kind != "keypoints":
        return "shows no turning; for gloves use `latency` with taps"
    if descriptor.frame not in {"world", "tracker"}:
        return "has keypoints in wrist axes, which do not turn with the hand"
    return None


def _camera_turning(
    reader: SpoolReader | RecordingReader, name: str, cameras: dict[str, Matrix], where: str
) -> Turning | str:
    camera, descriptor = name.removeprefix("camera_"), reader.streams[name]
    if f"K_{camera}" not in cameras:
        return f"needs K_{camera}: calibrate the camera first"
    if isinstance(reader, SpoolReader):
        if descriptor.unit == H264_UNIT:
            return "is h264, which only a store decodes: give the uploaded recording with --store"
        batch = reader.read(name)
        images: Iterator[np.ndarray] = (
            decode_jpeg(bytes(one)) if descriptor.unit == JPEG_UNIT else one for one in batch.values
        )
    else:
        batch, images = reader.stamps(name), _images(reader, name)
    check_lens(descriptor, cameras, where=where)
    timing = TakeStream(where, descriptor, batch, reader.attributes.calibration).timing()
    if len(timing.t_host_ns) < 2:
        return "has fewer than two images"
    rate_hz = 1e9 / float(np.median(np.diff(timing.t_host_ns)))
    if rate_hz < MIN_CAMERA_HZ:
        return (
            f"has {rate_hz:.0f} images a second, expected at least {MIN_CAMERA_HZ:g} to see a "
            "brisk turn"
        )
    is_kept = np.isin(np.arange(len(batch)), timing.kept)
    return turning_of_images(
        timing.t_host_ns,
        (image for image, kept in zip(images, is_kept, strict=True) if kept),
        np.array(cameras[f"K_{camera}"]),
        distortion_of(cameras, camera),
    )


def _images(reader: RecordingReader, name: str) -> Iterator[np.ndarray]:
    for first in range(0, reader.num_samples(name), _IMAGES_AT_ONCE):
        stop = min(first + _IMAGES_AT_ONCE, reader.num_samples(name))
        yield from reader.images_at(name, np.arange(first, stop))


def _written(
    options: argparse.Namespace,
    found: SharedTimes,
    calibrations: tuple[dict[str, Matrix], dict[str, Matrix]],
    left_out: dict[str, str],
    say: Say,
) -> dict[str, object]:
    """Write the delays; the calibrations are that of the take, and what is known by now."""
    subtracted, known = calibrations
    reference = found.reference
    reference_ns = number_of(known, f"{reference}_latency_ns")
    reference_ms = reference_ns * 1e-6
    # Of the reference, another delay may be known by now than was subtracted.
    correction_ns = reference_ns - number_of(subtracted, f"{reference}_latency_ns")
    rows: dict[str, dict[str, float]] = {}
    for name, delay in found.delays.items():
        if name == reference:
            continue
        # Times are without the delays that were known before: what is found comes on top.
        entry = f"{name}_latency"
        latency_ns = number_of(subtracted, f"{entry}_ns") + delay.offset_ns + correction_ns
        reference_sigma_ns = number_of(known, f"{reference}_latency_sigma_ns")
        sigma_ns = float(np.hypot(delay.sigma_ns, reference_sigma_ns))
        rows[name] = {"latency_ms": latency_ns * 1e-6, "sigma_ms": sigma_ns * 1e-6}
        facts: dict[str, object] = {
            "stream": name,
            "reference": reference,
            "reference_latency_ms": reference_ms,
            "method": "common turning",
            "take": options.take,
            **rows[name],
            "loop_sigmas": found.loop_sigmas,
        }
        matrices = {f"{entry}_ns": float(latency_ns), f"{entry}_sigma_ns": sigma_ns}
        write_entry(options.to, entry, matrices, facts)
        say(f"{entry:32} {latency_ns * 1e-6:8.2f} ± {sigma_ns * 1e-6:.2f} ms")
    say(
        f"relative to {reference}, which has {reference_ms:.2f} ms; "
        f"{len(found.pairs)} pairs of streams, loops close within {found.loop_sigmas:.1f} standard "
        "deviations"
    )
    for name, reason in left_out.items():
        say(f"left out: {name} {reason}")
    for (a, b), reason in found.unusable.items():
        say(f"not used: {a} and {b}: {reason}")
    return {
        "reference": reference,
        "streams": rows,
        "pairs": [
            {
                "a": pair.a,
                "b": pair.b,
                "offset_ms": pair.offset.offset_ns * 1e-6,
                "sigma_ms": pair.offset.sigma_ns * 1e-6,
            }
            for pair in found.pairs
        ],
        "loop_sigmas": found.loop_sigmas,
        "left_out": left_out,
        "unusable": [[a, b, reason] for (a, b), reason in found.unusable.items()],
    }
