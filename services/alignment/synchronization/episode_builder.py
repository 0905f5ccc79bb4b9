"""Builds an episode on one clock from a recording, without what cannot be true (docs/health.md)."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import cast, get_args

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.episodes import RecordingReader
from dextouch.errors import InvalidInputError
from dextouch.geometry import nearest_index
from dextouch.hands.robot_hand import NUM_JOINTS
from dextouch.schemas import (
    SHARED_ATTRIBUTES,
    Domain,
    EpisodeAttributes,
    LineageEntry,
    Matrix,
    StoredAnchor,
)
from dextouch.streams import (
    BODIES,
    COMMANDED,
    HandTraces,
    Implausible,
    StreamDescriptor,
    implausible_bodies,
    implausible_values,
    lasting_jumps,
)
from dextouch.tactile.layout import SIDES, TactileLayout, common_layout
from services.alignment.settings import AlignmentOptions
from services.alignment.synchronization import OnProgress, progress_within
from services.alignment.synchronization.checked_images import check_views, looked_at
from services.alignment.synchronization.grid_actions import (
    ACTION_STREAMS,
    TOUCH_STREAMS,
    GridActions,
    GriddedStreams,
    commanded_streams,
    make_actions,
    place_streams,
)
from services.alignment.synchronization.recorded_streams import (
    Block,
    DatedStream,
    EpisodeStream,
    LoadedStream,
    check_lens,
    cut_stream,
    date_stream,
    is_one_pose,
    marker_streams,
    with_tracked_objects,
)
from services.alignment.synchronization.resampling import (
    EDGE_PERIODS,
    MAX_GAP_PERIODS,
    RefusedReason,
    bridged_run,
    grid_times_ns,
    interpolated_fingers,
    interpolated_matrices,
    refused_edges,
    refused_matrices,
    refused_stretches,
    runs_of,
    stream_gap_ns,
    with_causes,
)

# Samples without which a stream is as if it were not there.
MIN_USABLE = 2


@dataclass(frozen=True)
class BuiltEpisode:
    """Attributes and streams of an episode; `complete_attributes` once all streams were taken."""

    attributes: EpisodeAttributes
    streams: tuple[EpisodeStream, ...]

    def complete_attributes(self) -> EpisodeAttributes:
        """The attributes with the figures that are known once every block was produced."""
        found = {name: n for stream in self.streams for name, n in stream.quality.items()}
        return self.attributes.model_copy(update={"quality": self.attributes.quality | found})


@dataclass(frozen=True)
class EpisodeSpan:
    """The part of a recording that becomes the episode; `matrices` say why the rest does not."""

    gridded: GriddedStreams
    origin_ns: int
    num_refused: int
    interpolated: Bool[np.ndarray, " n"]
    matrices: dict[str, Matrix]


@dataclass(frozen=True)
class CheckedStream:
    """A stream without its implausible samples, and from when to when, on the host's clock."""

    stream: DatedStream
    parts_ns: tuple[tuple[int, int, RefusedReason], ...] = ()


def checked_stream(stream: DatedStream, *, max_gap_ns: int) -> CheckedStream:
    """Check one stream, and leave out what is implausible.

    Where a tracker found itself anew, a gap is made longer than `max_gap_ns`, the longest that is
    interpolated. Raises InvalidInputError: the whole stream is implausible (`details`).
    """
    name, is_pose = stream.name, is_one_pose(stream.descriptor)
    if stream.implausible:
        return CheckedStream(*_left_out(stream, list(stream.implausible)))
    can_check = is_pose or stream.descriptor.kind in {"keypoints", "robot_state"}
    if not can_check or len(stream.t_ns) < 2:
        return CheckedStream(stream)
    raw = replace(stream, convert=np.asarray).load().values
    recorded = stream.recording.streams[name]
    of_robot = stream.recording.attributes.domain == "robot"
    found = implausible_values(recorded, stream.t_ns, raw, of_robot=of_robot)
    for one in found:
        if one.whole:
            raise InvalidInputError(
                f"stream {name!r}: {one.message}; correct what sends them, and record again",
                fault=one.cause,
                stream=name,
            )
    stream = _without_nodes(stream, found)
    stream, parts_ns = _left_out(stream, [one for one in found if one.nodes is None])
    if is_pose and not name.endswith(COMMANDED):
        return _cut_at_lasting_jumps(CheckedStream(stream, parts_ns), max_gap_ns)
    return CheckedStream(stream, parts_ns)


def check_bodies(streams: Mapping[str, DatedStream], domain: Domain) -> None:
    """Refuse a head and wrists that cannot be those of one body; raises InvalidInputError."""
    if not all(name in streams for name in BODIES):
        return
    t_ns = streams["head"].t_ns
    names = (*BODIES, *(name for name in streams if name.endswith(COMMANDED)))
    bodies = {n: streams[n] for n in names if n in streams and is_one_pose(streams[n].descriptor)}
    poses = {name: _poses_at(stream, t_ns) for name, stream in bodies.items()}
    to_body = {name: stream.convert for name, stream in bodies.items()}
    found = implausible_bodies(poses, to_body, of_robot=domain == "robot")
    if found is not None:
        raise InvalidInputError(
            f"stream {found.stream!r}: {found.message}, and record again",
            fault=found.cause,
            stream=found.stream,
        )


def check_hand_traces(streams: Mapping[str, DatedStream]) -> None:
    """Refuse wrists and gloves that do not go with their hands; raises InvalidInputError."""
    traces = HandTraces()
    if not any(name.startswith("keypoints") for name in streams):
        return
    for name in (f"{kind}_{side}" for kind in ("keypoints", "tactile", "wrist") for side in SIDES):
        if name in streams:
            about = streams[name].descriptor
            layout = about.tactile_layout if about.kind == "tactile" else None
            for piece in streams[name].pieces():
                traces.add(name, piece.t_ns, piece.values, layout)
    for name, (cause, message) in traces.found().items():
        text = f"stream {name!r}: {message}, and record again"
        raise InvalidInputError(text, fault=cause, stream=name)


def _left_out(
    stream: DatedStream, found: list[Implausible]
) -> tuple[DatedStream, tuple[tuple[int, int, RefusedReason], ...]]:
    """The stream without these samples, and the stretches that they leave."""
    parts: list[tuple[int, int, RefusedReason]] = []
    left_out = np.zeros(len(stream.t_ns), dtype=bool)
    quality = dict(stream.quality)
    for one in found:
        name = f"{stream.name}_num_{one.cause}_samples"
        quality[name] = quality.get(name, 0.0) + float(one.samples.sum())
        if one.harmless:
            continue
        left_out |= one.samples
        if one.factor > 1:
            # It is a slower stream than it says.
            rate_hz = stream.descriptor.nominal_rate_hz / one.factor
            slower = stream.descriptor.model_copy(update={"nominal_rate_hz": rate_hz})
            stream = replace(stream, descriptor=slower)
        elif one.cause in get_args(RefusedReason):
            parts += _parts_ns(stream.t_ns, one.samples, cast("RefusedReason", one.cause))
    return replace(_only(stream, ~left_out), quality=quality), tuple(parts)


def _only(stream: DatedStream, kept: Bool[np.ndarray, " n"]) -> DatedStream:
    timing = stream.timing
    timing = replace(timing, kept=timing.kept[kept], t_host_ns=timing.t_host_ns[kept])
    unseen = None if stream.unseen is None else stream.unseen[kept]
    return replace(stream, timing=timing, unseen=unseen)


def _parts_ns(
    t_ns: np.ndarray, samples: np.ndarray, reason: RefusedReason
) -> list[tuple[int, int, RefusedReason]]:
    """From the last sample before those that are wrong to the first one after them."""
    last = len(t_ns) - 1
    return [
        (int(t_ns[max(first - 1, 0)]), int(t_ns[min(stop, last)]), reason)
        for first, stop in runs_of(samples)
    ]


def _cut_at_lasting_jumps(checked: CheckedStream, max_gap_ns: int) -> CheckedStream:
    """Leave out samples around each jump of the tracker's world, so that nothing connects them."""
    stream = checked.stream
    loaded = stream.load()
    seen = np.isfinite(loaded.values).all(axis=1)
    t_ns, period_ns = loaded.t_ns[seen], stream.descriptor.period_ns()
    jumps = lasting_jumps(t_ns, loaded.values[seen], period_ns=period_ns)
    if not len(jumps):
        return checked
    reach_ns = stream_gap_ns(max_gap_ns, period_ns) // 2 + period_ns
    at_ns = (t_ns[jumps] + t_ns[jumps - 1]) // 2
    # Of the jumps around each sample the nearer one.
    after = np.searchsorted(at_ns, stream.t_ns).clip(max=len(at_ns) - 1)
    nearest = np.minimum(
        np.abs(stream.t_ns - at_ns[after]), np.abs(stream.t_ns - at_ns[np.maximum(after - 1, 0)])
    )
    near = nearest <= reach_ns
    quality = stream.quality | {f"{stream.name}_num_lasting_jumps": float(len(jumps))}
    parts_ns = (*checked.parts_ns, *_parts_ns(stream.t_ns, near, "jump"))
    return CheckedStream(replace(_only(stream, ~near), quality=quality), parts_ns)


def _without_nodes(stream: DatedStream, found: list[Implausible]) -> DatedStream:
    """The stream whose keypoints are not seen while only some of them are frozen."""
    ofs = [one for one in found if one.nodes is not None]
    if not ofs:
        return stream
    count = float(sum(one.nodes.sum() for one in ofs if one.nodes is not None))
    quality = stream.quality | {f"{stream.name}_num_frozen_nodes": count}
    lost = [one.nodes for one in ofs if not one.harmless]
    return replace(stream, unseen=lost[0] if lost else None, quality=quality)


def _poses_at(stream: DatedStream, t_ns: np.ndarray) -> Float64[np.ndarray, "n 7"]:
    """Poses as they were sent, of the samples nearest to these times."""
    raw = replace(stream, convert=np.asarray).load()
    poses = raw.values.astype(np.float64)
    seen = np.isfinite(poses).all(axis=1) & (np.linalg.norm(poses[:, 3:], axis=1) > 0)
    return poses[seen][nearest_index(raw.t_ns[seen], t_ns)] if seen.any() else poses[:0]


def build_episode(
    recording: RecordingReader,
    *,
    episode_id: str,
    options: AlignmentOptions,
    on_progress: OnProgress = lambda _: None,
) -> BuiltEpisode:
    """Fit all clocks, find the longest stretch without a long gap, and make actions on its grid.

    Time 0 is the first moment at which all streams of the action are there; values of others are
    read while the episode's blocks are taken. Raises InvalidInputError: streams or calibration are
    missing, or no stretch is long enough; ClockFitError: a stream whose stamps fit no clock.
    """
    check_complete(recording)
    objects = options.of_task(recording.attributes.task).objects
    streams = _dated_streams(recording, on_progress)
    _check_hands(recording, streams)
    streams = with_tracked_objects(streams, objects, recording.attributes.calibration)
    checked, views = _checked_streams(streams, recording, options)
    streams = {name: one.stream for name, one in checked.items()}
    span = find_span(recording, checked, options, on_progress)
    on_progress(progress_within("retargeting", 0.0))
    source, gridded = recording.attributes, span.gridded
    actions = make_actions(
        gridded,
        source.domain,
        source.calibration,
        wrist=options.wrist,
        max_gap_ns=options.max_gap_ns,
    )
    inside_ns = (span.origin_ns, span.origin_ns + int(np.ptp(gridded.grid_ns)))
    seen = marker_streams(
        recording,
        streams,
        objects,
        inside_ns,
        max_gap_ns=options.max_gap_ns,
        on_progress=on_progress,
    )
    on_progress(progress_within("writing", 0.0))
    grid_ns = gridded.grid_ns - gridded.grid_ns[0]
    written = [
        *_action_streams(actions, grid_ns, options),
        *(cut_stream(one, span.origin_ns, int(grid_ns[-1])) for one in streams.values()),
        *seen,
    ]
    quality = {
        "num_steps_refused": float(span.num_refused),
        "num_steps_interpolated": float(_num_interpolated(span, actions)),
        "origin_after_start_ns": float(span.origin_ns - (source.started_t_host_ns or 0)),
        **_stream_quality(streams, options),
        **actions.quality,
        **views,
    }
    attributes = _episode_attributes(recording, episode_id, actions, streams, quality)
    listed = () if objects is None else objects.tasks[source.task]
    more = {
        "model_rate_hz": options.model_rate_hz,
        "calibration": attributes.calibration
        | span.matrices
        | interpolated_fingers(grid_ns, actions.unseen_fingers),
        "object_names": tuple(one.name for one in listed),
        "object_boxes_m": tuple(one.box_m for one in listed),
    }
    return BuiltEpisode(attributes.model_copy(update=more), tuple(written))


def _checked_streams(
    streams: dict[str, DatedStream], recording: RecordingReader, options: AlignmentOptions
) -> tuple[dict[str, CheckedStream], dict[str, float]]:
    """The streams without what cannot be true, and figures of what cameras saw.

    Raises InvalidInputError: streams that do not fit each other.
    """
    looked = {n: looked_at(one) for n, one in streams.items() if one.descriptor.kind == "image"}
    streams = streams | {name: stream for name, (stream, _) in looked.items()}
    checked = {
        name: checked_stream(stream, max_gap_ns=options.longest_bridge_ns)
        for name, stream in streams.items()
    }
    streams = {name: one.stream for name, one in checked.items()}
    check_bodies(streams, recording.attributes.domain)
    check_hand_traces(streams)
    views = {name: view for name, (_, view) in looked.items()}
    return checked, check_views(views, streams, recording.attributes.calibration)


def _dated_streams(recording: RecordingReader, on_progress: OnProgress) -> dict[str, DatedStream]:
    """All streams but those of a single sample or none, which have no clock and show no motion."""
    streams = {}
    for number, name in enumerate(recording.streams):
        on_progress(progress_within("dating", number / len(recording.streams), name))
        if recording.num_samples(name) >= MIN_USABLE:
            streams[name] = date_stream(recording, name)
    return streams


def _num_interpolated(span: EpisodeSpan, actions: GridActions) -> int:
    """Steps in gaps of a stream, or of a finger that other steps have."""
    found = span.interpolated.copy()
    for unseen in actions.unseen_fingers.values():
        found |= unseen[:, ~unseen.all(axis=0)].any(axis=1)
    return int(np.count_nonzero(found))


def find_span(
    recording: RecordingReader,
    checked: Mapping[str, CheckedStream],
    options: AlignmentOptions,
    on_progress: OnProgress,
) -> EpisodeSpan:
    """Load the streams that actions are made of and choose the longest stretch that all share."""
    attributes, streams = recording.attributes, {n: one.stream for n, one in checked.items()}
    where = f"recording {attributes.recording_id!r}"
    names_of_action = [*ACTION_STREAMS[attributes.domain], *commanded_streams(streams)]
    if attributes.domain == "human" and options.wrist == "touch":
        names_of_action += TOUCH_STREAMS
    names = [name for name in names_of_action if name in streams]
    parts = {}
    for number, name in enumerate(names):
        on_progress(progress_within("placing", number / len(names), name))
        # Pressures of an hour do not fit in memory, the forces of its pads do.
        layout = streams[name].descriptor.tactile_layout
        if name in TOUCH_STREAMS:
            parts[name] = streams[name].load(partial(_pad_forces_n, layout))
        # Else such as a hand that was never seen.
        elif len((seen := _seen(streams[name].load())).t_ns) >= MIN_USABLE:
            parts[name] = seen
    _check_hands(recording, parts)
    # Touch may be missing for a while.
    needed = [name for name in parts if name not in TOUCH_STREAMS]
    first_ns = {name: int(parts[name].t_ns[0]) for name in needed}
    last_ns = {name: int(parts[name].t_ns[-1]) for name in needed}
    origin_ns = max(first_ns.values())
    stop_ns = min(
        last_ns[name] + round(EDGE_PERIODS * parts[name].descriptor.period_ns()) for name in needed
    )
    num_steps = int(max(stop_ns - origin_ns, 0) * 1e-9 * options.model_rate_hz) + 1
    # Relative to the origin from here on: int64 stays exact, floats stay small.
    moved = {name: replace(stream, t_ns=stream.t_ns - origin_ns) for name, stream in parts.items()}
    grid_ns = grid_times_ns(num_steps, options.model_rate_hz)
    gridded = place_streams(moved, grid_ns, max_gap_ns=options.max_gap_ns)
    valid = {name: gridded.at[name].valid for name in needed}
    first, stop = bridged_run(gridded.valid, max_steps=options.max_bridged_steps)
    if np.count_nonzero(gridded.valid[first:stop]) < options.min_num_steps:
        bad = {name: int((~mine).sum()) for name, mine in valid.items()}
        worst = ", ".join(f"{name} ({count})" for name, count in bad.items() if count) or "none"
        latest = max(first_ns, key=first_ns.__getitem__)
        earliest = min(last_ns, key=last_ns.__getitem__)
        worst += f"; {latest} begins last and {earliest} ends first"
        raise InvalidInputError(
            f"{where}: the longest stretch without a gap has {stop - first} of {num_steps} steps, "
            f"expected at least {options.min_num_steps}; steps lost to gaps above "
            f"{options.max_gap_ms:g} ms or {MAX_GAP_PERIODS} periods by stream: {worst}"
        )
    start_ns = attributes.started_t_host_ns
    if start_ns is None:
        start_ns = min(first_ns.values())
    refused = refused_edges(first_ns, last_ns, start_ns)
    refused += refused_stretches(grid_ns + origin_ns, valid, (first, stop), start_ns)
    inside = {name: mine[first:stop] for name, mine in valid.items()}
    causes_ns = {name: one.parts_ns for name, one in checked.items()}
    return EpisodeSpan(
        place_streams(moved, grid_ns[first:stop], max_gap_ns=options.longest_bridge_ns),
        origin_ns + int(grid_ns[first]),
        num_steps - (stop - first),
        ~gridded.valid[first:stop],
        refused_matrices(with_causes(refused, causes_ns, start_ns))
        | interpolated_matrices(grid_ns[first:stop] - grid_ns[first], inside),
    )


def _episode_attributes(
    recording: RecordingReader,
    episode_id: str,
    actions: GridActions,
    streams: Mapping[str, DatedStream],
    quality: dict[str, float],
) -> EpisodeAttributes:
    source = recording.attributes
    origin = LineageEntry(kind="recording", id=source.recording_id, sha256=recording.content_sha256)
    return EpisodeAttributes(
        **{name: getattr(source, name) for name in SHARED_ATTRIBUTES},
        episode_id=episode_id,
        origin="recorded",
        anchor=StoredAnchor.from_poses(actions.anchor),
        K_head=source.calibration.get("K_head"),
        absent=actions.absent,
        lineage=(*source.lineage, origin),
        calibration=source.calibration
        | {name: rows for stream in streams.values() for name, rows in stream.calibration.items()},
        clocks=tuple(stream.timing.report for stream in streams.values()),
        # What the station measured, too; of two figures with one name the aligned one counts.
        quality=source.quality | quality,
        created_at=source.started_at,
    )


def check_complete(recording: RecordingReader) -> None:
    """Refuse a recording without any hand or with wrong matrices; raises InvalidInputError."""
    where = f"recording {recording.attributes.recording_id!r}"
    streams = recording.streams
    _check_hands(recording, streams)
    of_actions = (*ACTION_STREAMS[recording.attributes.domain], *commanded_streams(streams))
    for name in ("joints_measured", "joints_commanded"):
        if name in of_actions and name in streams and streams[name].shape != (NUM_JOINTS * 2,):
            raise InvalidInputError(
                f"{where}: stream {name!r} has samples of {streams[name].shape}, expected the "
                f"{NUM_JOINTS * 2} joints of both hands in rad, left before right"
            )
    # One window holds both hands.
    common_layout(
        [stream.tactile_layout for name, stream in streams.items() if name in TOUCH_STREAMS],
        what=where,
    )
    for stream in streams.values():
        check_lens(stream, recording.attributes.calibration, where=where)


def _check_hands(recording: RecordingReader, streams: Collection[str]) -> None:
    """Refuse a recording of which no stream of a hand can be used; `streams` are those that can."""
    attributes = recording.attributes
    of_hands = [name for name in ACTION_STREAMS[attributes.domain] if name != "head"]
    if not any(name in streams for name in of_hands):
        raise InvalidInputError(
            f"recording {attributes.recording_id!r}: streams {of_hands} are missing or hold fewer "
            f"than {MIN_USABLE} usable samples; an episode of domain {attributes.domain!r} needs "
            f"one of them at least; it has {sorted(recording.streams)}",
            missing=of_hands,
        )


def _pad_forces_n(layout: TactileLayout, kpa: np.ndarray) -> Float64[np.ndarray, "n 6"]:
    """Forces of pads; NaN of those that miss a taxel."""
    is_missing = ~np.isfinite(kpa)
    forces_n = layout.pad_forces_n(np.where(is_missing, 0.0, kpa))
    some = is_missing.any(axis=1)
    forces_n[some] = np.where(layout.by_part(is_missing[some], np.any), np.nan, forces_n[some])
    return forces_n


def _seen(stream: LoadedStream) -> LoadedStream:
    """Drop samples without any keypoint; single missing keypoints stay."""
    if stream.values.dtype.kind != "f":
        return stream
    finite = np.isfinite(stream.values)
    if stream.descriptor.kind == "keypoints":
        useful = finite.all(axis=-1).any(axis=-1)
    else:
        useful = finite.reshape(len(finite), -1).all(axis=1)
    if useful.all():
        return stream
    return replace(stream, t_ns=stream.t_ns[useful], values=stream.values[useful])


def _action_streams(
    actions: GridActions, grid_ns: np.ndarray, options: AlignmentOptions
) -> Iterator[EpisodeStream]:
    descriptor = StreamDescriptor(
        name="action",
        kind="robot_state",
        shape=(67,),
        dtype="float64",
        unit="action",
        nominal_rate_hz=options.model_rate_hz,
    )
    yield EpisodeStream(descriptor, iter([Block(grid_ns, actions.measured)]))
    if actions.commanded is not None:
        commanded = descriptor.model_copy(update={"name": "action_commanded"})
        yield EpisodeStream(commanded, iter([Block(grid_ns, actions.commanded)]))


def _stream_quality(
    streams: Mapping[str, DatedStream], options: AlignmentOptions
) -> dict[str, float]:
    quality: dict[str, float] = {}
    for name, stream in streams.items():
        quality |= stream.quality
        max_gap_ns = stream_gap_ns(options.max_gap_ns, stream.descriptor.period_ns())
        quality[f"{name}_num_gaps"] = float((np.diff(stream.t_ns) > max_gap_ns).sum())
        if stream.timing.report.num_steps:
            quality[f"{name}_num_clock_steps"] = float(stream.timing.report.num_steps)
    return quality
