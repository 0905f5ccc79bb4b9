"""Command `dextouch station calibrate time`: path delays of everything that was shaken together."""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from dextouch.episodes import EpisodeStore, RecordingReader
from dextouch.episodes.spool import SpoolReader
from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.geometry import distortion_of, transform_from_pose
from dextouch.hands import PALM_NODES
from dextouch.images import decode_jpeg
from dextouch.schemas import Matrix
from dextouch.streams import H264_UNIT, JPEG_UNIT, StreamDescriptor, check_camera_matrix
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
    TakeStream,
    read_matrices,
    read_stream,
    write_entry,
)
from services.alignment.synchronization.stream_clock import time_stream

# Images that are decoded at once, so that ten seconds of a camera need no gigabyte.
_IMAGES_AT_ONCE: Final = 32
_COMMANDED: Final = "_commanded"
# Chosen: slower cameras lose the corners between two images of a brisk turn.
MIN_CAMERA_HZ: Final = 15.0

Say = Callable[[str], None]


def measure_times(options: argparse.Namespace, *, say: Say = print) -> dict[str, object]:
    """Measure the delays of all streams of a take that turned together, after a reference.

    Raises:
        DegenerateMotionError: too little, too slow or too regular motion, or streams that did not
            move together.
        InvalidInputError: fewer than two streams show how they turned.
    """
    where = f"take {options.take!r}"
    reader = _reader(options.take, options.store)
    cameras = dict(reader.attributes.calibration)
    if (options.to / MATRICES_FILE).exists():
        cameras |= read_matrices(options.to)
    wanted = None
    if options.streams is not None:
        wanted = [name.strip() for name in options.streams.split(",")]
    unknown = sorted(set(wanted or ()) - set(reader.streams))
    if unknown:
        raise NotFoundError(f"{where}: has no {', '.join(unknown)}, only {sorted(reader.streams)}")
    turnings: dict[str, Turning] = {}
    left_out: dict[str, str] = {}
    for name, descriptor in reader.streams.items():
        if wanted is not None and name not in wanted:
            continue
        reason = _unfit(descriptor, cameras, in_spool=isinstance(reader, SpoolReader))
        found = reason or _turning(options, reader, name, cameras)
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
    reference = options.reference or _best_known(turnings, cameras)
    known = _Known(dict(reader.attributes.calibration), cameras)
    return _written(options, shared_times(turnings, reference), known, left_out, say)


def _reader(take: str, store: str | None) -> SpoolReader | RecordingReader:
    if Path(take).is_dir():
        return SpoolReader(Path(take))
    if store:
        return EpisodeStore(store).recording(take)
    raise NotFoundError(
        f"take {take!r}: no such folder; name a take of the station's spool, or add --store URL "
        "for the id of a recording"
    )


def _unfit(
    descriptor: StreamDescriptor, cameras: dict[str, Matrix], *, in_spool: bool
) -> str | None:
    """Why a stream does not show how something turned; None if it does.

    Raises:
        InvalidInputError: a camera's matrix is none, or of images of another size.
    """
    name, kind = descriptor.name, descriptor.kind
    if kind == "pose" and not name.endswith(_COMMANDED):
        return None if descriptor.shape == (7,) else f"has poses of shape {descriptor.shape}"
    if kind == "keypoints":
        in_world = descriptor.frame in ("world", "tracker")
        return None if in_world else "has keypoints in wrist axes, which do not turn with the hand"
    if kind == "image":
        return _unfit_camera(descriptor, cameras, in_spool=in_spool)
    return "shows no turning; for gloves use `latency` with taps"


def _unfit_camera(
    descriptor: StreamDescriptor, cameras: dict[str, Matrix], *, in_spool: bool
) -> str | None:
    name = descriptor.name
    camera = name.removeprefix("camera_")
    if f"K_{camera}" not in cameras:
        return f"needs K_{camera}: calibrate the camera first"
    if in_spool and descriptor.unit == H264_UNIT:
        return "is h264, which only a store decodes: give the uploaded recording with --store"
    height_px, width_px = descriptor.shape[:2]
    size_px = cameras.get(f"image_size_{camera}_px", ((width_px, height_px),))[0]
    if tuple(size_px) != (width_px, height_px):
        raise InvalidInputError(
            f"K_{camera}: was measured on images of {size_px[0]:g} by {size_px[1]:g} px, but "
            f"{name!r} holds {width_px} by {height_px}; calibrate the camera in this mode"
        )
    K = np.array(cameras[f"K_{camera}"])
    check_camera_matrix(K, (width_px, height_px), where=f"K_{camera}")
    return None


def _turning(
    options: argparse.Namespace,
    reader: SpoolReader | RecordingReader,
    name: str,
    cameras: dict[str, Matrix],
) -> Turning | str:
    """How a stream turned, or why it does not show that."""
    descriptor = reader.streams[name]
    if descriptor.kind == "image":
        return _camera_turning(reader, name, cameras)
    stream = read_stream(options.take, name, options.store)
    if descriptor.kind == "pose":
        t_ns, poses = stream.poses()
        return turning_of_rotations(t_ns, transform_from_pose(poses)[:, :3, :3])
    t_ns, points_m = stream.timed()
    palm_m = points_m[:, PALM_NODES].astype(np.float64)
    whole = np.isfinite(palm_m).all(axis=(1, 2))
    return turning_of_points(t_ns[whole], palm_m[whole])


def _camera_turning(
    reader: SpoolReader | RecordingReader, name: str, cameras: dict[str, Matrix]
) -> Turning | str:
    camera, descriptor = name.removeprefix("camera_"), reader.streams[name]
    if isinstance(reader, SpoolReader):
        batch = reader.read(name)
        images: Iterator[np.ndarray] = (
            decode_jpeg(bytes(one)) if descriptor.unit == JPEG_UNIT else one for one in batch.values
        )
    else:
        batch, images = reader.stamps(name), _images(reader, name)
    timed = TakeStream(name, descriptor, batch, reader.attributes.calibration)
    timing = time_stream(batch, descriptor, latency_ns=round(timed.number(f"{name}_latency_ns")))
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


def _best_known(turnings: dict[str, Turning], calibration: dict[str, Matrix]) -> str:
    """The stream whose delay is known best; without any the first one, whose delay counts as 0."""

    def sigma_ns(name: str) -> float:
        return float(calibration.get(f"{name}_latency_sigma_ns", ((np.inf,),))[0][0])

    return min(turnings, key=sigma_ns)


@dataclass(frozen=True)
class _Known:
    """Delays that were subtracted from the take's times, and those that are known by now."""

    subtracted: dict[str, Matrix]
    best: dict[str, Matrix]

    def subtracted_ns(self, stream: str) -> float:
        return float(self.subtracted.get(f"{stream}_latency_ns", ((0.0,),))[0][0])

    def best_ns(self, stream: str) -> float:
        return float(self.best.get(f"{stream}_latency_ns", ((0.0,),))[0][0])

    def sigma_ns(self, stream: str) -> float:
        return float(self.best.get(f"{stream}_latency_sigma_ns", ((0.0,),))[0][0])


def _written(
    options: argparse.Namespace,
    found: SharedTimes,
    known: _Known,
    left_out: dict[str, str],
    say: Say,
) -> dict[str, object]:
    reference = found.reference
    reference_ms, sigma_ref_ns = known.best_ns(reference) * 1e-6, known.sigma_ns(reference)
    # Of the reference, another delay may be known by now than was subtracted.
    correction_ns = known.best_ns(reference) - known.subtracted_ns(reference)
    rows: dict[str, dict[str, float]] = {}
    for name, delay in found.delays.items():
        if name == reference:
            continue
        # Times are without the delays that were known before: what is found comes on top.
        latency_ns = known.subtracted_ns(name) + delay.offset_ns + correction_ns
        sigma_ns = float(np.hypot(delay.sigma_ns, sigma_ref_ns))
        facts: dict[str, object] = {
            "stream": name,
            "reference": reference,
            "reference_latency_ms": reference_ms,
            "method": "common turning",
            "take": options.take,
            "latency_ms": latency_ns * 1e-6,
            "sigma_ms": sigma_ns * 1e-6,
            "loop_sigmas": found.loop_sigmas,
        }
        entry = f"{name}_latency"
        matrices = {f"{entry}_ns": float(latency_ns), f"{entry}_sigma_ns": sigma_ns}
        write_entry(options.to, entry, matrices, facts)
        rows[name] = {"latency_ms": latency_ns * 1e-6, "sigma_ms": sigma_ns * 1e-6}
        say(f"{name + '_latency':32} {latency_ns * 1e-6:8.2f} ± {sigma_ns * 1e-6:.2f} ms")
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
