"""A recording's id in, its aligned episode in the same store out."""

import hashlib

import structlog

from dextouch.episodes import EpisodeStore, RecordingReader
from dextouch.errors import ConflictError
from services.alignment.options import AlignmentOptions
from services.alignment.report import AlignmentReport, report_of
from services.alignment.synchronization.episode_builder import (
    Progress,
    build_episode,
    check_complete,
)

logger = structlog.get_logger(__name__)

# Raised whenever alignment gives other numbers for the same recording and options.
ALIGNMENT_VERSION = 2
MAX_STEM = 100


def align_recording(
    store: EpisodeStore,
    recording_id: str,
    options: AlignmentOptions,
    tell: Progress | None = None,
) -> AlignmentReport:
    """Align one recording and write the episode.

    The episode's id follows from the recording's content and the options: doing it again, even
    from two processes at once, gives the same episode and writes nothing.

    Args:
        store: where the recording lies and the episode goes.
        recording_id: of a finished recording.
        options: of the alignment.
        tell: called with the progress, 0 … 1.

    Raises:
        NotFoundError: no such recording.
        InvalidInputError: the recording lacks what an episode needs (the message names it).
        CorruptDataError, StorageError: the store's bytes are damaged or cannot be written.
    """
    recording = store.recording(recording_id)
    episode_id = episode_id_of(recording, options)
    created = False
    if not store.exists(episode_id):
        created = _write(store, recording, episode_id, options, tell or _silent)
    return report_of(store.open(episode_id), recording_id=recording_id, created=created)


def check_recording(store: EpisodeStore, recording_id: str, options: AlignmentOptions) -> str:
    """The id of the episode-to-be, after a look at what the recording says about itself.

    Raises:
        NotFoundError: no such recording.
        InvalidInputError: streams or calibration that every episode needs are missing.
    """
    recording = store.recording(recording_id)
    check_complete(recording)
    return episode_id_of(recording, options)


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
    tell: Progress,
) -> bool:
    episode = build_episode(recording, episode_id=episode_id, options=options, tell=tell)
    try:
        with store.writer(kind="episode", attributes=episode.attributes) as writer:
            for stream in episode.streams:
                writer.add_stream(stream.descriptor)
                writer.append(
                    stream.descriptor.name, values=stream.values, t_ref_ns=stream.t_ref_ns
                )
    except ConflictError:
        # Another process was faster with the very same content.
        return False
    logger.info(
        "recording_aligned", recording_id=recording.attributes.recording_id, episode_id=episode_id
    )
    return True


def _silent(_: float) -> None:
    """Nobody asked for progress."""
