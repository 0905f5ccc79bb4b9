"""Read access for the routes: windows and samples as msgpack, limited in size, with ETags."""

import hashlib
from dataclasses import dataclass
from math import prod
from typing import Literal

from pydantic import BaseModel, Field

from dextouch.episodes import EpisodeReader, EpisodeStore, ImageForm, RecordingReader, encode_window
from dextouch.errors import LimitExceededError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import ActionKind, EpisodeDetail, RecordingAttributes
from dextouch.streams import pack
from services.episode_store.settings import EpisodeStoreSettings

# To be incremented whenever the same query gives other bytes.
ANSWER_VERSION = 1


class WindowQuery(FrozenModel):
    """Query of a window; `cameras` is a comma-separated list, which may be empty.

    Images are optionally at half size in both axes, or gray with one channel.
    """

    start: int = Field(ge=0)
    num_steps: int = Field(default=17, ge=1)
    cameras: str = "camera_head"
    action_kind: ActionKind = "measured"
    half_size: bool = False
    gray: bool = False


class SpanQuery(FrozenModel):
    """Query of samples: start_ns ≤ t < stop_ns, by default all."""

    start_ns: int | None = None
    stop_ns: int | None = None


@dataclass(frozen=True)
class Answer:
    """Response body and its ETag; no body if the client has it already."""

    etag: str
    data: bytes | None


class StoreReader:
    """Reads for the routes, with conditional requests and size limits, checked before reading."""

    def __init__(self, store: EpisodeStore, settings: EpisodeStoreSettings) -> None:
        self._store = store
        self._max_steps, self._max_bytes = settings.max_window_steps, settings.max_answer_bytes

    def episode(self, episode_id: str) -> EpisodeDetail:
        """Attributes, length and hash."""
        reader = self._store.open(episode_id)
        return EpisodeDetail(
            attributes=reader.attributes,
            num_steps=reader.num_steps,
            content_sha256=reader.content_sha256,
        )

    def recording_attributes(self, recording_id: str) -> RecordingAttributes:
        """Attributes of a finished recording."""
        return self._store.recording(recording_id).attributes

    def window(self, episode_id: str, query: WindowQuery, *, known: str | None = None) -> Answer:
        """One window; `known` is the `If-None-Match` of the request.

        Raises:
            LimitExceededError: more steps or bytes of images than allowed.
        """
        if query.num_steps > self._max_steps:
            raise LimitExceededError(
                f"window: got {query.num_steps} steps, expected at most {self._max_steps}",
                got=query.num_steps,
                expected=self._max_steps,
            )
        reader = self._store.open(episode_id)
        etag = etag_of(reader, "window", query)
        if is_known(etag, known):
            return Answer(etag, None)
        cameras = tuple(name for name in query.cameras.split(",") if name)
        form = ImageForm(half_size=query.half_size, gray=query.gray)
        # An unknown camera is refused by the reader.
        known_cameras = [reader.streams[name] for name in cameras if name in reader.streams]
        step_bytes = sum(
            prod(form.shape(stream.shape)) for stream in known_cameras if len(stream.shape) == 3
        )
        if query.num_steps * step_bytes > self._max_bytes:
            allowed = self._max_bytes // step_bytes
            raise LimitExceededError(
                f"window: {query.num_steps} steps hold {query.num_steps * step_bytes} bytes of "
                f"images, expected at most {self._max_bytes}, which are {allowed} steps; "
                "ask for fewer steps or cameras",
                got=query.num_steps,
                expected=allowed,
            )
        window = reader.window(
            query.start,
            query.num_steps,
            cameras=cameras,
            action_kind=query.action_kind,
            form=form,
        )
        return Answer(etag, encode_window(window))

    def samples(
        self,
        kind: Literal["episode", "recording"],
        item_id: str,
        stream: str,
        span: SpanQuery,
        *,
        known: str | None = None,
    ) -> Answer:
        """Stamps and values of one stream of an episode or a recording.

        Raises:
            LimitExceededError: more bytes than allowed.
        """
        reader: EpisodeReader | RecordingReader
        reader = self._store.open(item_id) if kind == "episode" else self._store.recording(item_id)
        etag = etag_of(reader, stream, span)
        if is_known(etag, known):
            return Answer(etag, None)
        count = reader.count(stream, span.start_ns, span.stop_ns)
        sample_bytes = reader.streams[stream].sample_bytes() + 24
        if count * sample_bytes > self._max_bytes:
            allowed = self._max_bytes // sample_bytes
            raise LimitExceededError(
                f"{stream}: {count} samples are {count * sample_bytes} bytes, expected at most "
                f"{self._max_bytes}, which are {allowed} samples; ask for a shorter time",
                got=count,
                expected=allowed,
            )
        return Answer(etag, _packed(reader, stream, span))


def _packed(reader: EpisodeReader | RecordingReader, stream: str, span: SpanQuery) -> bytes:
    # The fields of both kinds of answers are arrays: stamps, then values.
    return pack({"stream": stream}, vars(reader.read(stream, span.start_ns, span.stop_ns)))


def etag_of(reader: EpisodeReader | RecordingReader, what: str, query: BaseModel) -> str:
    """ETag of content and query; valid forever since committed groups are immutable."""
    text = f"{ANSWER_VERSION} {reader.content_sha256} {what} {query.model_dump_json()}"
    return f'"{hashlib.sha256(text.encode()).hexdigest()[:40]}"'


def is_known(etag: str, known: str | None) -> bool:
    """Whether an ETag is listed in an `If-None-Match` header."""
    if known is None:
        return False
    tags = {tag.strip().removeprefix("W/") for tag in known.split(",")}
    return etag in tags or "*" in tags
