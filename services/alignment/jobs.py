"""Alignment of one recording: builds its episode and writes it to the same store."""

import hashlib
from collections.abc import Sequence

import structlog

from dextouch.episodes import EpisodeStore, EpisodeWriter, RecordingReader
from dextouch.errors import ConflictError, DexTouchError, InvalidInputError, NotFoundError
from services.alignment.options import AlignmentOptions
from services.alignment.report import AlignmentReport, report_of
from services.alignment.synchronization.episode_builder import (
    BuiltEpisode,
    build_episode,
    check_complete,
)
from services.alignment.synchronization.progress import OnProgress, progress_within

logger = structlog.get_logger(__name__)

# Raised whenever alignment gives other numbers for the same recording and options.
ALIGNMENT_VERSION = 3
MAX_STEM = 100
# Refused recordings that a message lists; its details have all.
MAX_LISTED = 5


def align_recording(
    store: EpisodeStore,
    recording_id: str,
    options: AlignmentOptions,
    on_progress: OnProgress = lambda _: None,
) -> AlignmentReport:
    """Align one recording and write the episode.

    The episode's id follows from the recording's content and the options: doing it again, even
    from two processes at once, gives the same episode and writes nothing. Progress is told in the
    caller's thread.

    Raises:
        NotFoundError: no such recording.
        InvalidInputError: the recording lacks data that an episode needs (the message names it).
        CorruptDataError, StorageError: the store's bytes are damaged or cannot be written.
    """
    recording = store.recording(recording_id)
    episode_id = episode_id_of(recording, options)
    created = not store.exists(episode_id) and _write(
        store, recording, episode_id, options, on_progress
    )
    return report_of(store.open(episode_id), recording_id=recording_id, created=created)


def check_recording(store: EpisodeStore, recording_id: str, options: AlignmentOptions) -> str:
    """Check that a recording has the data that an episode needs; returns the id of its episode.

    Raises:
        NotFoundError: no such recording.
        InvalidInputError: streams or calibration that every episode needs are missing.
    """
    recording = store.recording(recording_id)
    check_complete(recording)
    return episode_id_of(recording, options)


def check_recordings(
    store: EpisodeStore, recording_ids: Sequence[str], options: AlignmentOptions
) -> dict[str, str]:
    """Check several recordings; returns the id of each one's episode.

    Raises:
        NotFoundError: no such recording; of several, the message names all that are refused.
        InvalidInputError: one lacks what every episode needs.
    """
    episodes: dict[str, str] = {}
    refused: dict[str, DexTouchError] = {}
    for recording_id in recording_ids:
        try:
            episodes[recording_id] = check_recording(store, recording_id, options)
        except (NotFoundError, InvalidInputError) as error:
            if len(recording_ids) == 1:
                raise
            refused[recording_id] = error
    if refused:
        told = "; ".join([error.message for error in refused.values()][:MAX_LISTED])
        more = f"; and {len(refused) - MAX_LISTED} more" if len(refused) > MAX_LISTED else ""
        unknown = all(isinstance(error, NotFoundError) for error in refused.values())
        raise (NotFoundError if unknown else InvalidInputError)(
            f"alignments: {len(refused)} of {len(recording_ids)} recordings cannot be aligned, so "
            f"no job was started; omit them: {told}{more}",
            refused={recording_id: error.message for recording_id, error in refused.items()},
        )
    return episodes


def episode_id_of(recording: RecordingReader, options: AlignmentOptions) -> str:
    """The id of the episode that a recording becomes under these options."""
    identity = f"{ALIGNMENT_VERSION} {recording.content_sha256} {options.model_dump_json()}"
    digest = hashlib.sha256(identity.encode()).hexdigest()[:12]
    return f"{recording.attributes.recording_id[:MAX_STEM]}-{digest}"


def _write(
    store: EpisodeStore,
    recording: RecordingReader,
    episode_id: str,
    options: AlignmentOptions,
    on_progress: OnProgress,
) -> bool:
    episode = build_episode(
        recording, episode_id=episode_id, options=options, on_progress=on_progress
    )
    try:
        with store.writer(kind="episode", attributes=episode.attributes) as writer:
            _write_streams(writer, episode, on_progress)
            writer.set_attributes(episode.complete_attributes())
    except ConflictError:
        # Another process has written the same episode meanwhile.
        return False
    logger.info(
        "recording_aligned", recording_id=recording.attributes.recording_id, episode_id=episode_id
    )
    return True


def _write_streams(writer: EpisodeWriter, episode: BuiltEpisode, on_progress: OnProgress) -> None:
    """Write the samples of every stream; empty streams are omitted."""
    num_streams = len(episode.streams)
    for number, stream in enumerate(episode.streams):
        name = stream.descriptor.name
        for index, block in enumerate(stream.blocks):
            if not index:
                writer.add_stream(stream.descriptor)
            writer.append(name, values=block.values, t_ref_ns=block.t_ns)
            on_progress(progress_within("writing", number / num_streams, name))
