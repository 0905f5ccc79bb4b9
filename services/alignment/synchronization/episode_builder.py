"""A recording in, an episode on one reference clock out, not yet written anywhere."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int64, Shaped

from dextouch.errors import InvalidInputError
from dextouch.schemas.episodes import (
    EpisodeAttributes,
    LineageEntry,
    StoredAnchor,
)
from dextouch.streams.descriptors import StreamDescriptor
from services.alignment.calibration.lens_record import check_lenses
from services.alignment.options import AlignmentOptions
from services.alignment.synchronization.grid_actions import (
    COMMANDED_STREAMS,
    REQUIRED,
    GridActions,
    GriddedStreams,
    make_actions,
    place_streams,
)
from services.alignment.synchronization.recorded_streams import (
    AlignedStream,
    Recording,
    read_stream,
)
from services.alignment.synchronization.resampling import (
    EDGE_PERIODS,
    GridPlacement,
    grid_times_ns,
    longest_run,
)

Progress = Callable[[float], None]
# How much of the work is done when all streams are read, and when the actions are made.
READING_SHARE = 0.5
BUILT_SHARE = 0.8


@dataclass(frozen=True)
class EpisodeStream:
    """One stream ready to be written."""

    descriptor: StreamDescriptor
    t_ref_ns: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."]


@dataclass(frozen=True)
class BuiltEpisode:
    """Attributes and streams of an episode."""

    attributes: EpisodeAttributes
    streams: tuple[EpisodeStream, ...]


def build_episode(
    recording: Recording,
    *,
    episode_id: str,
    options: AlignmentOptions,
    tell: Progress = lambda _: None,
) -> BuiltEpisode:
    """Date all streams, find the longest stretch without a gap, and put actions on its grid.

    Streams that the recording lacks are left out. Time 0 of the episode is the first moment at
    which all streams that make up the action are there.

    Raises:
        InvalidInputError: streams or calibration that every episode needs are missing, or no
            stretch without a gap is long enough.
        ClockFitError: a stream whose stamps fit no clock.
    """
    attributes = recording.attributes
    check_complete(recording)
    streams = {}
    for number, name in enumerate(recording.streams):
        tell(READING_SHARE * number / len(recording.streams))
        streams[name] = read_stream(recording, name)
    tell(READING_SHARE)
    names = [*REQUIRED[attributes.domain], *COMMANDED_STREAMS]
    parts = {name: _seen(streams[name]) for name in names if name in streams}
    origin_ns, gridded = _common_stretch(parts, options, attributes.recording_id)
    run = longest_run(gridded.valid)
    if run[1] - run[0] < options.min_num_steps:
        raise InvalidInputError(_too_short(gridded, run, options, attributes.recording_id))
    chosen = _slice(gridded, run)
    actions = make_actions(chosen, attributes.domain)
    tell(BUILT_SHARE)
    origin_ns += int(chosen.grid_ns[0])
    grid_ns = chosen.grid_ns - chosen.grid_ns[0]
    written = [
        *_action_streams(actions, grid_ns, options),
        *(_cut(stream.complete(), origin_ns, int(grid_ns[-1])) for stream in streams.values()),
    ]
    quality = {
        "num_steps_refused": float(len(gridded.valid) - len(grid_ns)),
        "origin_after_start_ns": float(origin_ns - (attributes.started_t_host_ns or 0)),
        **_stream_quality(streams, options),
        **actions.quality,
    }
    return BuiltEpisode(
        _episode_attributes(recording, episode_id, actions, streams, quality).model_copy(
            update={"model_rate_hz": options.model_rate_hz}
        ),
        tuple(stream for stream in written if len(stream.t_ref_ns)),
    )


def _episode_attributes(
    recording: Recording,
    episode_id: str,
    actions: GridActions,
    streams: Mapping[str, AlignedStream],
    quality: dict[str, float],
) -> EpisodeAttributes:
    source = recording.attributes
    origin = LineageEntry(kind="recording", id=source.recording_id, sha256=recording.content_sha256)
    return EpisodeAttributes(
        episode_id=episode_id,
        task=source.task,
        instruction=source.instruction,
        domain=source.domain,
        origin="recorded",
        station=source.station,
        operator=source.operator,
        anchor=StoredAnchor.from_poses(actions.anchor),
        K_head=source.calibration["K_head"],
        success=source.success,
        recovered=source.recovered,
        lineage=(*source.lineage, origin),
        calibration=source.calibration
        | {name: rows for stream in streams.values() for name, rows in stream.calibration.items()},
        clocks=tuple(stream.timing.report for stream in streams.values()),
        # What the station measured, too; of two figures with one name the aligned one counts.
        quality=source.quality | quality,
        created_at=source.started_at,
    )


def check_complete(recording: Recording) -> None:
    """Refuse a recording from which no episode can be made.

    Raises:
        InvalidInputError: names the streams or the calibration that are missing or do not fit.
    """
    attributes = recording.attributes
    missing = [name for name in REQUIRED[attributes.domain] if name not in recording.streams]
    if missing:
        raise InvalidInputError(
            f"recording {attributes.recording_id!r}: streams {missing} are missing, which an "
            f"episode of domain {attributes.domain!r} needs; it has {sorted(recording.streams)}",
            missing=missing,
        )
    if "K_head" not in attributes.calibration:
        raise InvalidInputError(
            f"recording {attributes.recording_id!r}: calibration 'K_head' (3 by 3, pixels) is "
            f"missing; it has {sorted(attributes.calibration)}",
            missing=["K_head"],
        )
    where = f"recording {attributes.recording_id!r}"
    check_lenses(attributes.calibration, recording.streams, where=where)


def _seen(stream: AlignedStream) -> AlignedStream:
    """Without samples that show nothing at all; single missing keypoints stay."""
    if stream.descriptor.kind != "keypoints":
        return stream.complete()
    anything = np.isfinite(stream.values).all(axis=-1).any(axis=-1)
    return replace(stream, t_ns=stream.t_ns[anything], values=stream.values[anything])


def _common_stretch(
    parts: Mapping[str, AlignedStream], options: AlignmentOptions, recording_id: str
) -> tuple[int, GriddedStreams]:
    """The first common moment on the host's clock, and the streams on a grid that starts there."""
    empty = [name for name, stream in parts.items() if len(stream.t_ns) < 2]
    if empty:
        raise InvalidInputError(
            f"recording {recording_id!r}: streams {empty} hold fewer than two usable samples"
        )
    start_ns = max(int(stream.t_ns[0]) for stream in parts.values())
    stop_ns = min(
        int(stream.t_ns[-1]) + round(EDGE_PERIODS * stream.descriptor.period_ns())
        for stream in parts.values()
    )
    num_steps = int(max(stop_ns - start_ns, 0) * 1e-9 * options.model_rate_hz) + 1
    # Relative to the origin from here on: int64 stays exact, floats stay small.
    moved = {name: _moved(stream, start_ns) for name, stream in parts.items()}
    grid_ns = grid_times_ns(num_steps, options.model_rate_hz)
    return start_ns, place_streams(moved, grid_ns, max_gap_ns=options.max_gap_ns)


def _moved(stream: AlignedStream, origin_ns: int) -> AlignedStream:
    return replace(stream, t_ns=stream.t_ns - origin_ns)


def _slice(gridded: GriddedStreams, run: tuple[int, int]) -> GriddedStreams:
    part = slice(*run)
    at = {
        name: GridPlacement(place.left[part], place.weight[part], place.valid[part])
        for name, place in gridded.at.items()
    }
    return GriddedStreams(gridded.grid_ns[part], gridded.streams, at, gridded.valid[part])


def _cut(stream: AlignedStream, origin_ns: int, last_ns: int) -> EpisodeStream:
    """The samples of the episode's time, with the neighbours that its ends need."""
    margin_ns = round(EDGE_PERIODS * stream.descriptor.period_ns())
    t_ref_ns = stream.t_ns - origin_ns
    inside = (t_ref_ns >= -margin_ns) & (t_ref_ns <= last_ns + margin_ns)
    return EpisodeStream(stream.descriptor, t_ref_ns[inside], stream.values[inside])


def _action_streams(
    actions: GridActions, grid_ns: np.ndarray, options: AlignmentOptions
) -> list[EpisodeStream]:
    kinds = {"action": actions.measured, "action_commanded": actions.commanded}
    return [
        EpisodeStream(
            StreamDescriptor(
                name=name,
                kind="robot_state",
                shape=(67,),
                dtype="float64",
                unit="action",
                nominal_rate_hz=options.model_rate_hz,
            ),
            grid_ns,
            values,
        )
        for name, values in kinds.items()
        if values is not None
    ]


def _stream_quality(
    streams: Mapping[str, AlignedStream], options: AlignmentOptions
) -> dict[str, float]:
    quality: dict[str, float] = {}
    for name, stream in streams.items():
        quality |= stream.quality
        quality[f"{name}_num_gaps"] = float((np.diff(stream.t_ns) > options.max_gap_ns).sum())
        if stream.timing.num_steps:
            quality[f"{name}_num_clock_steps"] = float(stream.timing.num_steps)
        incomplete = len(stream.t_ns) - len(stream.complete().t_ns)
        if incomplete:
            quality[f"{name}_num_incomplete"] = float(incomplete)
    return quality


def _too_short(
    gridded: GriddedStreams,
    run: tuple[int, int],
    options: AlignmentOptions,
    recording_id: str,
) -> str:
    bad = {name: int((~place.valid).sum()) for name, place in gridded.at.items()}
    worst = ", ".join(f"{name} ({count})" for name, count in bad.items() if count) or "none"
    return (
        f"recording {recording_id!r}: the longest stretch without a gap has {run[1] - run[0]} of "
        f"{len(gridded.valid)} steps, expected at least {options.min_num_steps}; steps lost to "
        f"gaps above {options.max_gap_ms:g} ms by stream: {worst}"
    )
