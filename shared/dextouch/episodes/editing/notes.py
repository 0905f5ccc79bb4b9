"""Notes of people on time ranges of an item: add, remove, and where their seconds begin."""

from datetime import UTC, datetime

from dextouch.episodes.format import Kind
from dextouch.episodes.reader import EpisodeReader, RecordingReader
from dextouch.episodes.store import EpisodeStore
from dextouch.errors import InvalidInputError, LimitExceededError, NotFoundError
from dextouch.schemas import MAX_NOTES, ItemNotes, NewNote, TimedNote


def zero_ns(reader: EpisodeReader | RecordingReader) -> int:
    """Second 0 of an item on its clock: step 0 of an episode, the start of a recording."""
    if isinstance(reader, EpisodeReader):
        return int(reader.stamps_ns("action")[0]) if reader.num_steps else 0
    started_ns = reader.attributes.started_t_host_ns
    return time_span_ns(reader)[0] if started_ns is None else started_ns


def time_span_ns(reader: EpisodeReader | RecordingReader) -> tuple[int, int]:
    """Stamps of the first and the last sample of an item; raises InvalidInputError without any."""
    stamps = [reader.stamps_ns(name) for name in reader.streams]
    ends = [(int(one[0]), int(one[-1])) for one in stamps if len(one)]
    if not ends:
        raise InvalidInputError(f"{reader.item_id!r}: has no sample, and no time to speak of")
    return min(first for first, _ in ends), max(last for _, last in ends)


def add_note(
    store: EpisodeStore, item_id: str, given: NewNote, *, kind: Kind = "episode"
) -> TimedNote:
    """Keep a note on an item.

    Raises InvalidInputError for a range that is empty or outside the item, LimitExceededError for
    more than MAX_NOTES, and as `EpisodeStore.review`.
    """
    reader = store.open_item(kind, item_id)
    first_ns, last_ns = time_span_ns(reader)
    if not given.start_ns <= given.stop_ns or given.stop_ns < first_ns or given.start_ns > last_ns:
        zero = zero_ns(reader)
        got, expected = (
            f"{(low - zero) / 1e9:.3f} … {(high - zero) / 1e9:.3f} s"
            for low, high in ((given.start_ns, given.stop_ns), (first_ns, last_ns))
        )
        raise InvalidInputError(
            f"note on {kind} {item_id!r}: got the range {got}, expected one within {expected}"
        )
    added: list[TimedNote] = []

    def add(notes: ItemNotes) -> ItemNotes:
        if len(notes.notes) >= MAX_NOTES:
            raise LimitExceededError(
                f"note on {kind} {item_id!r}: it has {MAX_NOTES} notes, expected at most as many; "
                "remove one first"
            )
        number = 1 + max((one.number for one in notes.notes), default=0)
        added.append(TimedNote(number=number, written_at=datetime.now(UTC), **given.model_dump()))
        ordered = sorted([*notes.notes, *added], key=lambda one: (one.start_ns, one.number))
        return ItemNotes(notes=tuple(ordered))

    store.change_notes(item_id, add, kind=kind)
    return added[0]


def remove_note(
    store: EpisodeStore, item_id: str, number: int, *, kind: Kind = "episode"
) -> ItemNotes:
    """Remove a note by its number, and return the others; raises NotFoundError without it."""

    def remove(notes: ItemNotes) -> ItemNotes:
        kept = tuple(one for one in notes.notes if one.number != number)
        if len(kept) == len(notes.notes):
            numbers = ", ".join(str(one.number) for one in notes.notes) or "none"
            raise NotFoundError(
                f"note {number} on {kind} {item_id!r}: not there; its notes are {numbers}"
            )
        return ItemNotes(notes=kept)

    return store.change_notes(item_id, remove, kind=kind)
