"""Twin episodes by the real path: mock devices, drivers, recorder, clock fits and retargeting.

The way from a person's hands to 67-D actions of the robot, without HTTP. Episodes have the errors
of an ordinary station (clocks, delays, tracking, calibration, lost packets) and, as labels, what
only the twin knows: object poses, milestones and success. Labels are on the episode's time axis:
the clock of the simulated host is that of the simulation.
"""

import tempfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Int64, Shaped

from dextouch.episodes import EpisodeStore
from dextouch.episodes.spool import SpoolReader
from dextouch.errors import InvalidInputError
from dextouch.geometry import nearest_index
from dextouch.schemas import (
    EpisodeAttributes,
    Matrix,
    SceneObjects,
    TakePrompt,
    object_stream,
)
from dextouch.streams import StreamDescriptor
from services.acquisition.clock import VirtualClock
from services.acquisition.mocks.pattern import pattern_streams
from services.acquisition.mocks.replay import PLAYED_KINDS, ReplayStream
from services.alignment.retargeting import warm_up
from services.alignment.settings import AlignmentOptions
from services.alignment.synchronization.episode_builder import build_episode
from services.alignment.synchronization.recorded_streams import EpisodeStream
from services.episode_store.committing import commit_spool
from services.pipelines.mock_takes import TakePlan, measure_gloves, origin_in_truth_ns, play_take
from services.twin.episodes import TruthEpisode
from services.twin.recorder import NUM_LAST_SHOWN_STEPS, TruthStream
from services.twin.simulation import MODEL_RATE_HZ
from services.twin.take_options import TakeOptions

STATION: Final = "twin"
# Seeds in a row that share a station: its gloves are calibrated once.
SESSION_SEEDS: Final = 20
# As in docs/twin_closure.md: with wrists as tracked, the robot's hand touches something else.
ALIGNMENT: Final = AlignmentOptions(wrist="touch")
LABELS: Final = "object_poses"
# What training reads, beside images.
_TRAINED: Final = ("action", "action_commanded", "tactile_left", "tactile_right", LABELS)


@dataclass(frozen=True)
class AlignedStream:
    """One stream of an episode in memory."""

    descriptor: StreamDescriptor
    t_ns: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."]


def device_options(options: TakeOptions) -> TakeOptions:
    """Options of the ground truth that the devices play: every stream, images at 30 Hz."""
    return replace(options, image_every=None, streams="all")


def write_through_devices(
    store: EpisodeStore, truth: TruthEpisode, *, episode_id: str, options: TakeOptions
) -> None:
    """Record a take of the twin with a mock station, align it and write it with the twin's labels.

    Equal takes give equal episodes. The recording itself is not kept.

    Args:
        store: where the episode goes.
        truth: recorded with `device_options`.
        episode_id: of the new episode.
        options: `streams` and `image_every` say what the episode has.

    Raises:
        ConflictError: the episode exists.
        InvalidInputError: the take could not be aligned.
        DeviceError: a mock device failed.
    """
    aligned = _aligned(truth, ALIGNMENT, episode_id)
    about = aligned.attributes
    label = _label(truth.streams[LABELS], aligned.origin_ns, aligned.streams[0].t_ns)
    attributes = _with_truth(about, truth.attributes, aligned.origin_ns)
    _write(store, attributes, [label, *aligned.streams], options)


def write_as_recorded(
    store: EpisodeStore,
    truth: TruthEpisode,
    objects: SceneObjects,
    *,
    episode_id: str,
    options: TakeOptions,
) -> None:
    """Record a take with a mock station and write what alignment makes of it, and nothing else.

    Poses of objects are those of the markers in the images. Of the twin's truth the episode has
    only the outcome, which an operator would see.

    Args:
        store: where the episode goes.
        truth: recorded with `device_options`, by a stage that shows the markers.
        objects: of the task, with their markers.
        episode_id: of the new episode.
        options: `streams` and `image_every` say what the episode has.

    Raises:
        ConflictError: the episode exists.
        InvalidInputError: the take could not be aligned.
        DeviceError: a mock device failed.
    """
    aligned = _aligned(truth, ALIGNMENT.model_copy(update={"objects": objects}), episode_id)
    # The recording is not kept, and the wall clock would differ each time.
    attributes = aligned.attributes.model_copy(update={"created_at": None, "lineage": ()})
    _write(store, attributes, aligned.streams, options)


@dataclass(frozen=True)
class _Aligned:
    """An aligned take in memory; `origin_ns` is its time 0 on the axis of the truth."""

    attributes: EpisodeAttributes
    streams: list[AlignedStream]
    origin_ns: int


def _aligned(truth: TruthEpisode, alignment: AlignmentOptions, episode_id: str) -> _Aligned:
    """Play a take through a mock station and align its recording."""
    about = truth.attributes
    if about.seed is None:
        raise InvalidInputError(f"device takes: {episode_id} has no seed; expected a twin's take")
    _warm_up()
    session = about.seed // SESSION_SEEDS
    plan = TakePlan(
        _played(truth.streams),
        TakePrompt(task=about.task, instruction=about.instruction, domain=about.domain),
        about.success,
        {**about.calibration, "K_head": about.K_head, **_session_gloves(session)},
        recording_id="take",
        seed=zlib.crc32(episode_id.encode()),
        unit_seed=session,
    )
    with tempfile.TemporaryDirectory(prefix="dextouch-take-") as name:
        folder = Path(name)
        take, _ = play_take(plan, folder / "spool", station=STATION)
        local = EpisodeStore(folder / "store")
        commit_spool(local, take.spool_path, SpoolReader(take.spool_path).attributes)
        recording = local.recording(take.recording_id)
        built = build_episode(recording, episode_id=episode_id, options=alignment)
        streams = [_in_memory(stream) for stream in built.streams]
        started_ns = recording.attributes.started_t_host_ns
    attributes = built.complete_attributes()
    if started_ns is None:
        raise InvalidInputError(f"device takes: {episode_id} has no start time; record it again")
    origin_ns = origin_in_truth_ns(take, started_t_host_ns=started_ns, quality=attributes.quality)
    return _Aligned(attributes, streams, origin_ns)


def _write(
    store: EpisodeStore,
    attributes: EpisodeAttributes,
    streams: Sequence[AlignedStream],
    options: TakeOptions,
) -> None:
    """Write those streams and images that the options ask for."""
    written = list(streams)
    if options.streams == "training":
        names = (*_TRAINED, *options.images, *map(object_stream, attributes.object_names))
        written = [one for one in written if one.descriptor.name in names]
    if options.image_every is not None:
        grid_ns = next(one.t_ns for one in streams if one.descriptor.name == "action")
        written = [_thinned(one, grid_ns, options.image_every) for one in written]
    with store.writer(kind="episode", attributes=attributes) as to:
        for one in written:
            to.add_stream(one.descriptor)
            to.append(one.descriptor.name, values=one.values, t_ref_ns=one.t_ns)


@lru_cache(maxsize=1)
def _warm_up() -> None:
    """Load the compiled solver once per process."""
    warm_up()


@lru_cache(maxsize=4)
def _session_gloves(session: int) -> dict[str, Matrix]:
    """Calibration of the gloves of a session, measured by a take with known pressures."""
    gloves = [stream for stream in pattern_streams(1.0) if stream.descriptor.kind == "tactile"]
    with tempfile.TemporaryDirectory(prefix="dextouch-calibration-") as folder:
        return measure_gloves(gloves, Path(folder), seed=session, clock=VirtualClock())


def _played(streams: Mapping[str, TruthStream]) -> list[ReplayStream]:
    """Streams that devices send; actions are made by alignment."""
    return [
        ReplayStream(stream.descriptor, stream.t_ref_ns, stream.values)
        for name, stream in streams.items()
        if stream.descriptor.kind in PLAYED_KINDS
        and name != LABELS
        and stream.descriptor.unit != "action_m_rad"
    ]


def _in_memory(stream: EpisodeStream) -> AlignedStream:
    blocks = list(stream.blocks)
    return AlignedStream(
        stream.descriptor,
        np.concatenate([block.t_ns for block in blocks]),
        np.concatenate([block.values for block in blocks]),
    )


def _label(truth: TruthStream, origin_ns: int, grid_ns: np.ndarray) -> AlignedStream:
    """True object poses with the time axis of the episode, from its first to its last step."""
    t_ns = truth.t_ref_ns - origin_ns
    period_ns = truth.descriptor.period_ns()
    inside = (t_ns > grid_ns[0] - period_ns) & (t_ns < grid_ns[-1] + period_ns)
    return AlignedStream(truth.descriptor, t_ns[inside], truth.values[inside])


def _thinned(stream: AlignedStream, grid_ns: np.ndarray, image_every: int) -> AlignedStream:
    """An image stream with the images nearest to every N-th step and to the last three."""
    if stream.descriptor.kind != "image":
        return stream
    steps = sorted(
        {*range(0, len(grid_ns), image_every), *range(len(grid_ns))[-NUM_LAST_SHOWN_STEPS:]}
    )
    kept = np.unique(nearest_index(stream.t_ns, grid_ns[steps]))
    rate_hz = MODEL_RATE_HZ / image_every
    descriptor = stream.descriptor.model_copy(update={"nominal_rate_hz": rate_hz})
    return AlignedStream(descriptor, stream.t_ns[kept], stream.values[kept])


def _with_truth(
    aligned: EpisodeAttributes, truth: EpisodeAttributes, origin_ns: int
) -> EpisodeAttributes:
    """Attributes of the aligned episode with the twin's, whose command repeats the ground truth."""
    return aligned.model_copy(
        update={
            "origin": truth.origin,
            "seed": truth.seed,
            "generator_command": truth.generator_command,
            "object_names": truth.object_names,
            "object_boxes_m": truth.object_boxes_m,
            "event_times_s": {
                name: max(0.0, t_s - origin_ns * 1e-9) for name, t_s in truth.event_times_s.items()
            },
            "quality": truth.quality | aligned.quality,
            # The recording is not kept, and the wall clock would differ each time.
            "lineage": truth.lineage,
            "created_at": truth.created_at,
        }
    )
