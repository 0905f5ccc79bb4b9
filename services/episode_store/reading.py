"""HTTP routes of single items: attributes, and windows and samples as msgpack with ETags."""

import hashlib
from collections.abc import Callable
from functools import partial
from math import prod
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query, Response
from pydantic import BaseModel, Field

from dextouch.episodes import EpisodeReader, EpisodeStore, ImageForm, RecordingReader, encode_window
from dextouch.errors import LimitExceededError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import ActionKind, EpisodeDetail, RecordingAttributes
from dextouch.serving import MSGPACK, RequireScope
from dextouch.streams import pack
from services.episode_store.settings import EpisodeStoreSettings

# To be incremented whenever the same query gives other bytes.
ANSWER_VERSION = 1
MAY_READ = Depends(RequireScope("store_read"))
WINDOW_MSGPACK = "application/vnd.dextouch.window+msgpack"
# Committed content is immutable but may be deleted: clients must revalidate.
CACHE_CONTROL = "private, no-cache"
# Responses of these routes besides the problems that all routes can give.
SAMPLES: dict[str, Any] = {
    "response_class": Response,
    "responses": {200: {"content": {MSGPACK: {}}}, 304: {}},
}
WINDOW: dict[str, Any] = {
    "response_class": Response,
    "responses": {200: {"content": {WINDOW_MSGPACK: {}}}, 304: {}},
}
IfNoneMatch = Annotated[str | None, Header(alias="if-none-match")]


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


def content_router(store: EpisodeStore, settings: EpisodeStoreSettings) -> APIRouter:
    """Create the routes of single recordings and episodes; sizes are checked before reading."""
    router = APIRouter(prefix="/v1", dependencies=[MAY_READ])
    max_steps, max_bytes = settings.max_window_steps, settings.max_answer_bytes

    @router.get("/recordings/{recording_id}/attributes", tags=["recordings"])
    def attributes(recording_id: str) -> RecordingAttributes:
        """Attributes of a finished recording."""
        return store.recording(recording_id).attributes

    @router.get("/recordings/{recording_id}/streams/{stream}", tags=["recordings"], **SAMPLES)
    def recording_samples(
        recording_id: str,
        stream: str,
        span: Annotated[SpanQuery, Query()],
        if_none_match: IfNoneMatch = None,
    ) -> Response:
        """Samples of a finished recording with start_ns ≤ t_host_ns < stop_ns, as msgpack."""
        reader = store.recording(recording_id)
        read = partial(_samples, reader, stream, span, max_bytes)
        return response(etag_of(reader, stream, span), if_none_match, read, MSGPACK)

    @router.get("/episodes/{episode_id}", tags=["episodes"])
    def episode(episode_id: str) -> EpisodeDetail:
        """Attributes of an episode."""
        reader = store.open(episode_id)
        return EpisodeDetail(
            attributes=reader.attributes,
            num_steps=reader.num_steps,
            content_sha256=reader.content_sha256,
        )

    @router.get("/episodes/{episode_id}/windows", tags=["episodes"], **WINDOW)
    def window(
        episode_id: str,
        query: Annotated[WindowQuery, Query()],
        if_none_match: IfNoneMatch = None,
    ) -> Response:
        """Window of the model grid as msgpack (`dextouch.episodes.decode_window`)."""
        if query.num_steps > max_steps:
            raise LimitExceededError(
                f"window: got {query.num_steps} steps, expected at most {max_steps}",
                got=query.num_steps,
                expected=max_steps,
            )
        reader = store.open(episode_id)
        read = partial(_window, reader, query, max_bytes)
        return response(etag_of(reader, "window", query), if_none_match, read, WINDOW_MSGPACK)

    @router.get("/episodes/{episode_id}/streams/{stream}", tags=["episodes"], **SAMPLES)
    def episode_samples(
        episode_id: str,
        stream: str,
        span: Annotated[SpanQuery, Query()],
        if_none_match: IfNoneMatch = None,
    ) -> Response:
        """Samples with start_ns ≤ t_ref_ns < stop_ns as msgpack."""
        reader = store.open(episode_id)
        read = partial(_samples, reader, stream, span, max_bytes)
        return response(etag_of(reader, stream, span), if_none_match, read, MSGPACK)

    return router


def response(etag: str, known: str | None, read: Callable[[], bytes], media_type: str) -> Response:
    """Response with ETag; 304 without a body if the client has it already."""
    headers = {"etag": etag, "cache-control": CACHE_CONTROL}
    if is_known(etag, known):
        return Response(status_code=304, headers=headers)
    return Response(read(), media_type=media_type, headers=headers)


def _window(reader: EpisodeReader, query: WindowQuery, max_bytes: int) -> bytes:
    cameras = tuple(name for name in query.cameras.split(",") if name)
    form = ImageForm(half_size=query.half_size, gray=query.gray)
    # An unknown camera is refused by the reader.
    known_cameras = [reader.streams[name] for name in cameras if name in reader.streams]
    step_bytes = sum(
        prod(form.shape(stream.shape)) for stream in known_cameras if len(stream.shape) == 3
    )
    if query.num_steps * step_bytes > max_bytes:
        allowed = max_bytes // step_bytes
        raise LimitExceededError(
            f"window: {query.num_steps} steps hold {query.num_steps * step_bytes} bytes of "
            f"images, expected at most {max_bytes}, which are {allowed} steps; "
            "ask for fewer steps or cameras",
            got=query.num_steps,
            expected=allowed,
        )
    window = reader.window(
        query.start, query.num_steps, cameras=cameras, action_kind=query.action_kind, form=form
    )
    return encode_window(window)


def _samples(
    reader: EpisodeReader | RecordingReader, stream: str, span: SpanQuery, max_bytes: int
) -> bytes:
    count = reader.count(stream, span.start_ns, span.stop_ns)
    sample_bytes = reader.streams[stream].sample_bytes() + 24
    if count * sample_bytes > max_bytes:
        allowed = max_bytes // sample_bytes
        raise LimitExceededError(
            f"{stream}: {count} samples are {count * sample_bytes} bytes, expected at most "
            f"{max_bytes}, which are {allowed} samples; ask for a shorter time",
            got=count,
            expected=allowed,
        )
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
