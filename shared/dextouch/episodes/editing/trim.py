"""Trims: a new item of the samples of a span, each stream at its own rate.

An episode is cut at steps of its model grid. A stream keeps the samples of the span, and of both
sides the neighbour that the values at its first and last step are made of. An encoded image stays
as it is: of H.264 the group of pictures of the first image stays whole, unless `exact`.
"""

from collections.abc import Collection, Iterator, Mapping
from itertools import islice

import numpy as np

from dextouch.episodes.editing.edits import DEFAULTS, Edit, EditOptions, new_outcome, time_span_ns
from dextouch.episodes.format import GOP_IMAGES, STAMPS
from dextouch.episodes.reader import ACTION_STREAMS, SAME_INSTANT_NS, EpisodeReader, RecordingReader
from dextouch.episodes.store import EpisodeStore
from dextouch.episodes.validity import interpolated_actions
from dextouch.episodes.writer import EpisodeWriter
from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.schemas import (
    ActionKind,
    EditedItem,
    EditedOutcome,
    EpisodeAttributes,
    Matrix,
    StoredAnchor,
)
from dextouch.streams import ENCODED_UNITS, H264_UNIT, encoded_values

# Figures of an episode that hold of every part of it: taxels that alignment refused throughout.
_OF_EVERY_PART = "_taxels"
# Of one block, as of the uploads of a commit.
_BLOCK_BYTES = 4 << 20
_BLOCK_IMAGES = 4 * GOP_IMAGES
# Of names that a message lists.
_SHOWN = 6
Span = tuple[int, int]


def steps_between(reader: EpisodeReader, from_s: float | None, to_s: float | None) -> Span:
    """First step, and the one after the last, at from_s ≤ t < to_s seconds after step 0.

    None is the start or the end. Raises InvalidInputError for an empty span, or one outside.
    """
    if not reader.num_steps:
        raise InvalidInputError(f"episode {reader.item_id!r}: has no steps; align its recording")
    grid_ns = reader.stamps_ns("action")
    t_ns = grid_ns - grid_ns[0]
    end_s = (int(t_ns[-1]) * 1e-9) + 1.0 / reader.attributes.model_rate_hz
    low_s, high_s = 0.0 if from_s is None else from_s, end_s if to_s is None else to_s
    if not (0.0 <= low_s < high_s <= end_s + 1e-6):
        raise InvalidInputError(
            f"episode {reader.item_id!r}: got a span from {low_s:g} to {high_s:g} s, expected one "
            f"within 0 … {end_s:.3f} s"
        )
    edges_ns = [round(low_s * 1e9) - SAME_INSTANT_NS, round(high_s * 1e9) - SAME_INSTANT_NS]
    first, stop = (int(edge) for edge in np.searchsorted(t_ns, edges_ns))
    if stop - first < 2:
        raise InvalidInputError(
            f"episode {reader.item_id!r}: fewer than two steps between {low_s:g} and {high_s:g} s; "
            f"steps are {1e3 / reader.attributes.model_rate_hz:.1f} ms apart"
        )
    return first, stop


def trim_episode(
    store: EpisodeStore,
    episode_id: str,
    steps: Span,
    *,
    outcome: EditedOutcome | None = None,
    exact: bool = False,
    options: EditOptions = DEFAULTS,
) -> EditedItem:
    """Write the steps first … stop − 1 of an episode as a new one, which supersedes it.

    Args:
        store: where the episode is.
        episode_id: of the source.
        steps: first step, and the one after the last.
        outcome: of the result; None keeps it, which the end of a judged episode must not lack.
        exact: encode H.264 images anew from the cut on.
        options: of all edits.

    Raises:
        InvalidInputError: steps outside the episode, or no outcome where one must be given.
        NotFoundError, CorruptDataError: as `EpisodeStore.open`, also while samples are read.
        ConflictError: the new id is taken. UnavailableError: another program edits the episode.
    """
    with store.held(episode_id):
        reader = store.open(episode_id)
        first, stop = steps
        if not 0 <= first < stop - 1 < reader.num_steps:
            raise InvalidInputError(
                f"episode {episode_id!r}: got steps {first} … {stop - 1}, expected a span of two "
                f"or more within its {reader.num_steps} steps"
            )
        text = f"trim --steps {first} {stop}" + f" --outcome {outcome}" * bool(outcome)
        edit = Edit(store, reader, "trimmed", text + " --exact" * exact, options)
        attributes = _trimmed_attributes(edit, reader, steps, outcome)
        spans = {name: _span_of(reader, name, steps, exact=exact) for name in reader.streams}
        grid_ns = reader.stamps_ns("action")
        zero_ns = int(grid_ns[first] - grid_ns[0])

        def write(writer: EpisodeWriter) -> None:
            for stream in reader.attributes.streams:
                for values, stamps_ns in _episode_blocks(
                    reader, stream.name, spans[stream.name], exact=exact
                ):
                    writer.append(stream.name, values=values, t_ref_ns=stamps_ns - zero_ns)

        last_ns = None if stop == reader.num_steps else int(grid_ns[stop - 1])
        remarks = edit.remarks(
            span_ns=(None if first == 0 else int(grid_ns[first]), last_ns),
            shift_ns=zero_ns,
            clicks_hold=first == 0,
        )
        counts = {name: high - low for name, (low, high) in spans.items()}
        return edit.run(attributes, counts, write, remarks)


def _some(names: Collection[str]) -> str:
    """The first names, and how many there are beside."""
    shown, beside = ", ".join(islice(names, _SHOWN)), len(names) - _SHOWN
    return f"{shown}, and {beside} more" if beside > 0 else shown


def _trimmed_attributes(
    edit: Edit, reader: EpisodeReader, steps: Span, outcome: EditedOutcome | None
) -> EpisodeAttributes:
    """Attributes of the result, with figures of the whole episode left out."""
    about, (first, stop) = reader.attributes, steps
    grid_ns = reader.stamps_ns("action")
    is_cut_off = stop < reader.num_steps
    changes: dict[str, object] = {
        "episode_id": edit.new_id,
        "lineage": edit.lineage,
        "generator_command": None,
    }
    changes |= new_outcome(about, outcome, lacking="its end is cut off" * is_cut_off)
    if (first, stop) == (0, reader.num_steps):
        return about.model_copy(update=changes)
    zero_s, last_s = ((int(grid_ns[at] - grid_ns[0])) * 1e-9 for at in (first, stop - 1))
    if first:
        changes["anchor"] = StoredAnchor.from_poses(reader.anchor(first))
    events = {
        name: at_s - zero_s
        for name, at_s in about.event_times_s.items()
        if zero_s <= at_s <= last_s
    }
    if lost := sorted(set(about.event_times_s) - set(events)):
        edit.messages.append(f"events outside are left out: {', '.join(lost)}")
    # On the episode's clock, on which step 0 need not be at 0.
    origin_s = int(grid_ns[0]) * 1e-9
    span_s = origin_s + zero_s, origin_s + last_s + 1.0 / about.model_rate_hz
    calibration = _cut_intervals(about.calibration, span_s, zero_s)
    quality = {name: n for name, n in about.quality.items() if name.endswith(_OF_EVERY_PART)}
    if "origin_after_start_ns" in about.quality:
        start_ns = about.quality["origin_after_start_ns"] + round(zero_s * 1e9)
        quality["origin_after_start_ns"] = start_ns
    if "num_steps_interpolated" in about.quality:
        kinds: tuple[ActionKind, ...] = ("measured", "commanded")
        found = [interpolated_actions(about.calibration, grid_ns[first:stop], k) for k in kinds]
        quality["num_steps_interpolated"] = float(np.any(found, axis=(0, 2)).sum())
    if lost := sorted(set(about.quality) - set(quality)):
        edit.messages.append(f"figures of the whole are left out: {_some(lost)}")
    changes |= {"event_times_s": events, "calibration": calibration, "quality": quality}
    return about.model_copy(update=changes)


def _cut_intervals(
    calibration: Mapping[str, Matrix], span_s: tuple[float, float], shift_s: float
) -> dict[str, Matrix]:
    """A calibration with its interpolated intervals cut to a span, on a clock that is behind."""
    found, (start_s, stop_s) = dict(calibration), span_s
    for name in calibration:
        if not (name.startswith("interpolated_") and name.endswith("_s")):
            continue
        rows = [
            (max(start, start_s) - shift_s, min(end, stop_s) - shift_s, *rest)
            for start, end, *rest in calibration[name]
            if start < stop_s and end > start_s
        ]
        if rows:
            found[name] = tuple(rows)
        else:
            del found[name]
    return found


def _span_of(reader: EpisodeReader, name: str, steps: Span, *, exact: bool) -> Span:
    """First sample of a stream that a span of steps needs, and the one after the last."""
    first, stop = steps
    if name in ACTION_STREAMS.values():
        return steps
    stamps_ns, grid_ns = reader.stamps_ns(name), reader.stamps_ns("action")
    low, high = 0, len(stamps_ns)
    if first > 0:
        before = stamps_ns.searchsorted(grid_ns[first] + SAME_INSTANT_NS, "right")
        low = max(int(before) - 1, 0)
    if stop < reader.num_steps:
        high = min(int(stamps_ns.searchsorted(grid_ns[stop - 1] - SAME_INSTANT_NS)) + 1, high)
    if reader.streams[name].kind == "image" and high > low:
        try:
            # Where the neighbours are damaged, those that are shown in their place.
            shown = reader.nearest_images(name, grid_ns[[first, stop - 1]])
        except NotFoundError:
            shown = np.array([low, high - 1])
        low, high = min(low, int(shown[0])), max(high, int(shown[1]) + 1)
    return _from_group(reader, name, low, exact=exact), high


def _from_group(
    reader: EpisodeReader | RecordingReader, name: str, low: int, *, exact: bool
) -> int:
    """A first image from where H.264 images can go over as they are: the one of its group."""
    is_group = reader.streams[name].unit == H264_UNIT and not exact
    return low - low % GOP_IMAGES if is_group else low


def _episode_blocks(
    reader: EpisodeReader, name: str, span: Span, *, exact: bool
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Values and stamps of a span; actions are relative to its first step."""
    low, high = span
    kinds = {stream: kind for kind, stream in ACTION_STREAMS.items()}
    if name not in kinds:
        for places, values in _blocks(reader, name, span, exact=exact):
            yield values, reader.stamps_ns(name)[places]
        return
    dtype = reader.streams[name].numpy_dtype()
    # From step 0 on they are relative to the right one: to change them would only round them.
    is_kept = low == 0
    values = (
        reader.values(name, low, high)
        if is_kept
        else reader.actions(low, high - low, kind=kinds[name]).astype(dtype)
    )
    yield values, reader.stamps_ns(name)[low:high]


def _blocks(
    reader: EpisodeReader | RecordingReader, name: str, span: Span, *, exact: bool
) -> Iterator[tuple[np.ndarray | slice, np.ndarray]]:
    """Places and values of samples of a span, encoded images as they are."""
    stream, (low, high) = reader.streams[name], span
    is_encoded = stream.unit in ENCODED_UNITS
    is_anew = exact and stream.unit == H264_UNIT and low % GOP_IMAGES > 0
    rows = max(1, _BLOCK_BYTES // stream.sample_bytes())
    for start in range(low, high, _BLOCK_IMAGES if is_encoded else rows):
        stop = min(start + (_BLOCK_IMAGES if is_encoded else rows), high)
        if is_anew:
            places = np.arange(start, stop)
            places = np.setdiff1d(places, reader.damaged_images(name, places))
            yield places, reader.images_at(name, places)
        elif is_encoded:
            images = encoded_values(reader.encoded_images(name, start, stop))
            yield slice(start, stop), images
        else:
            yield slice(start, stop), reader.values(name, start, stop)


def trim_recording(
    store: EpisodeStore,
    recording_id: str,
    from_s: float | None,
    to_s: float | None,
    *,
    outcome: EditedOutcome | None = None,
    options: EditOptions = DEFAULTS,
) -> EditedItem:
    """Write the samples of a recording at from_s ≤ t < to_s seconds after its start as a new one.

    Its raw samples and stamps stay as they are; H.264 images go over in whole groups. Raises as
    `trim_episode`.
    """
    with store.held(recording_id, kind="recording"):
        reader = store.recording(recording_id)
        about = reader.attributes
        first_ns, last_ns = time_span_ns(reader)
        zero_ns = about.started_t_host_ns
        zero_ns = first_ns if zero_ns is None else zero_ns
        low_ns = None if from_s is None else zero_ns + round(from_s * 1e9)
        high_ns = None if to_s is None else zero_ns + round(to_s * 1e9)
        start_ns = first_ns if low_ns is None else low_ns
        stop_ns = last_ns + 1 if high_ns is None else high_ns
        is_inside = start_ns <= last_ns and stop_ns > first_ns
        if not (start_ns < stop_ns and is_inside and min(from_s or 0, to_s or 0) >= 0):
            raise InvalidInputError(
                f"recording {recording_id!r}: got a span from {(start_ns - zero_ns) / 1e9:g} to "
                f"{(stop_ns - zero_ns) / 1e9:g} s, expected one within 0 … "
                f"{(last_ns - zero_ns) / 1e9:.3f} s"
            )
        bounds = (("--from", from_s), ("--to", to_s), ("--outcome", outcome))
        text = "".join(f" {key} {value}" for key, value in bounds if value is not None)
        edit = Edit(store, reader, "trimmed", f"trim{text}", options)
        is_cut_off = high_ns is not None and high_ns <= last_ns
        changes = new_outcome(about, outcome, lacking="its end is cut off" * is_cut_off)
        more = {"recording_id": edit.new_id, "lineage": edit.lineage, "quality": {}}
        if about.quality:
            edit.messages.append(f"figures of the whole are left out: {_some(about.quality)}")
        spans: dict[str, Span] = {}
        for name in reader.streams:
            stamps_ns = reader.stamps_ns(name)
            low, high = (int(at) for at in np.searchsorted(stamps_ns, [start_ns, stop_ns]))
            spans[name] = (_from_group(reader, name, low, exact=False) if high > low else low, high)

        def write(writer: EpisodeWriter) -> None:
            for stream in about.streams:
                stamps = reader.stamps(stream.name)
                columns = {one: getattr(stamps, one) for one in STAMPS["recording"]}
                for places, values in _blocks(reader, stream.name, spans[stream.name], exact=False):
                    block = {one: column[places] for one, column in columns.items()}
                    writer.append(stream.name, values=values, **block)

        remarks = edit.remarks(span_ns=(low_ns, high_ns), clicks_hold=False)
        counts = {name: high - low for name, (low, high) in spans.items()}
        changed = about.model_copy(update=more | changes | {"num_batches": {}})
        return edit.run(changed, counts, write, remarks)
