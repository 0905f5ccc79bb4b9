"""HTTP routes for players: extents and gaps of an item, JPEG images of a span, reduced signals."""

from collections.abc import Callable
from functools import partial
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Query, Response

from dextouch.episodes import EpisodeReader, EpisodeStore, ImageForm, RecordingReader
from dextouch.errors import InvalidInputError, LimitExceededError
from dextouch.images import encode_jpeg
from dextouch.schemas import ItemKind, Playback, PlayedStream
from dextouch.serving import MSGPACK, RequireScope
from dextouch.streams import JPEG_UNIT, StreamDescriptor, pack
from services.episode_store.reading import SAMPLES, IfNoneMatch, SpanQuery, etag_of, response
from services.episode_store.robot_hands import RobotHandsQuery, robot_hands
from services.episode_store.settings import EpisodeStoreSettings
from services.episode_store.signals import SignalsQuery, reduce_signals

MAY_READ = Depends(RequireScope("store_read"))
GAP_PERIODS = 1.5
MAX_GAPS = 50
MAX_IMAGES = 240
QUALITY = 85
Reader = EpisodeReader | RecordingReader


class ImagesQuery(SpanQuery):
    """Query of images: start_ns ≤ t < stop_ns, optionally at half size in both axes."""

    half_size: bool = False


def playback_router(store: EpisodeStore, settings: EpisodeStoreSettings) -> APIRouter:
    """Create the routes below /v1/playback; sizes are checked before reading."""
    router = APIRouter(prefix="/v1/playback", dependencies=[MAY_READ], tags=["playback"])

    def opened(kind: ItemKind, item_id: str) -> Reader:
        return store.open(item_id) if kind == "episode" else store.recording(item_id)

    @router.get("/{kind}/{item_id}")
    def about(kind: ItemKind, item_id: str) -> Playback:
        """What can be played of an item: its streams with their extents and longest gaps."""
        return playback_of(opened(kind, item_id))

    @router.get("/{kind}/{item_id}/images/{camera}", **SAMPLES)
    def images(
        kind: ItemKind,
        item_id: str,
        camera: str,
        query: Annotated[ImagesQuery, Query()],
        if_none_match: IfNoneMatch = None,
    ) -> Response:
        """JPEG images of a span: arrays `t_ns`, `num_bytes` of each, and `data`, one by one."""
        reader = opened(kind, item_id)
        read = partial(_images, reader, camera, query, settings.max_answer_bytes)
        return response(etag_of(reader, f"jpeg {camera}", query), if_none_match, read, MSGPACK)

    @router.get("/{kind}/{item_id}/signals", **SAMPLES)
    def signals(
        kind: ItemKind,
        item_id: str,
        query: Annotated[SignalsQuery, Query()],
        if_none_match: IfNoneMatch = None,
    ) -> Response:
        """Lowest and highest value per bin of time: arrays `NAME/low`, `NAME/high` [points]."""
        reader = opened(kind, item_id)
        read: Callable[[], bytes] = partial(reduce_signals, reader, query)
        return response(etag_of(reader, "signals", query), if_none_match, read, MSGPACK)

    @router.get("/episode/{item_id}/robot_hands", **SAMPLES)
    def hands(
        item_id: str,
        query: Annotated[RobotHandsQuery, Query()],
        if_none_match: IfNoneMatch = None,
    ) -> Response:
        """Points of both robot hands in the world, from the actions of a span."""
        reader = store.open(item_id)
        read = partial(robot_hands, reader, query)
        return response(etag_of(reader, "robot_hands", query), if_none_match, read, MSGPACK)

    return router


def playback_of(reader: Reader) -> Playback:
    """Facts about an item for a player; reads the stamps of every stream."""
    streams = tuple(_played(reader, stream) for stream in reader.streams.values())
    firsts = [stream.first_ns for stream in streams if stream.first_ns is not None]
    lasts = [stream.last_ns for stream in streams if stream.last_ns is not None]
    about = reader.attributes
    names = ("task", "instruction", "domain", "station", "operator", "success", "recovered")
    shared = {name: getattr(about, name) for name in (*names, "lineage")}
    span = {"start_ns": min(firsts, default=0), "stop_ns": max(lasts, default=0)}
    if isinstance(reader, EpisodeReader):
        origin_ns = reader.attributes.quality.get("origin_after_start_ns")
        own = {
            "kind": "episode",
            "origin": reader.attributes.origin,
            "at": reader.attributes.created_at,
            "model_rate_hz": reader.attributes.model_rate_hz,
            "num_steps": reader.num_steps,
            "origin_after_start_ns": None if origin_ns is None else round(origin_ns),
        }
    else:
        own = {
            "kind": "recording",
            "origin": "recorded",
            "at": reader.attributes.started_at,
            "started_t_host_ns": reader.attributes.started_t_host_ns,
        }
    return Playback.model_validate(shared | span | own | {"id": reader.item_id, "streams": streams})


def _played(reader: Reader, stream: StreamDescriptor) -> PlayedStream:
    stamps_ns = reader.stamps_ns(stream.name)
    steps_ns = np.diff(stamps_ns)
    gaps = np.flatnonzero(steps_ns > GAP_PERIODS * stream.period_ns())
    longest = np.sort(gaps[np.argsort(steps_ns[gaps], kind="stable")[-MAX_GAPS:]])
    return PlayedStream(
        name=stream.name,
        kind=stream.kind,
        shape=stream.shape,
        unit=stream.unit,
        side=stream.side,
        frame=stream.frame,
        nominal_rate_hz=stream.nominal_rate_hz,
        num_samples=len(stamps_ns),
        first_ns=int(stamps_ns[0]) if len(stamps_ns) else None,
        last_ns=int(stamps_ns[-1]) if len(stamps_ns) else None,
        num_gaps=len(gaps),
        gaps_ns=tuple((int(stamps_ns[k]), int(stamps_ns[k + 1])) for k in longest),
    )


def _images(reader: Reader, camera: str, query: ImagesQuery, max_bytes: int) -> bytes:
    count = reader.count(camera, query.start_ns, query.stop_ns)
    descriptor = reader.streams[camera]
    if descriptor.kind != "image":
        raise InvalidInputError(f"images: {camera!r} is a stream of kind {descriptor.kind!r}")
    form = ImageForm(half_size=query.half_size)
    image_bytes = int(np.prod(form.shape(descriptor.shape)))
    allowed = max(1, min(MAX_IMAGES, max_bytes // image_bytes))
    if count > allowed:
        raise LimitExceededError(
            f"{camera}: the span holds {count} images, expected at most {allowed}; "
            "ask for a shorter time",
            got=count,
            expected=allowed,
        )
    stamps_ns = reader.stamps_ns(camera)
    first = 0 if query.start_ns is None else int(stamps_ns.searchsorted(query.start_ns))
    # A browser would fill in what is missing of a damaged image.
    indices = np.arange(first, first + count)
    indices = np.setdiff1d(indices, reader.damaged_images(camera, indices))
    if descriptor.unit == JPEG_UNIT and not query.half_size:
        images = reader.encoded_images(camera, first, first + count)
        encoded = [images[index - first] for index in indices.tolist()]
    else:
        pictures = reader.images_at(camera, indices, form=form)
        encoded = [encode_jpeg(picture, quality=QUALITY) for picture in pictures]
    return pack(
        {"camera": camera},
        {
            "t_ns": stamps_ns[indices],
            "num_bytes": np.array([len(one) for one in encoded], dtype=np.int64),
            "data": np.frombuffer(b"".join(encoded), dtype=np.uint8),
        },
    )
