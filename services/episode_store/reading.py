"""HTTP routes of single items: attributes, windows and samples, and what players show."""

import hashlib
from collections.abc import Callable, Iterator
from functools import partial
from math import prod
from typing import Annotated, Any, Final

import numpy as np
from fastapi import APIRouter, Header, Query, Response
from jaxtyping import Float64
from pydantic import AfterValidator, BaseModel, Field

from dextouch import episodes, schemas
from dextouch.errors import InvalidInputError, LimitExceededError
from dextouch.frozen_model import FrozenModel
from dextouch.hands.actions import ACTION_DIM, action_names, poses_from_actions
from dextouch.hands.robot_hand import RobotHand
from dextouch.images import encode_jpeg
from dextouch.serving import MSGPACK
from dextouch.streams import JPEG_UNIT, StreamDescriptor, pack
from dextouch.tactile.layout import SIDES
from services.episode_store.keys import MAY_READ
from services.episode_store.settings import EpisodeStoreSettings

# To be incremented whenever the same query gives other bytes.
ANSWER_VERSION = 1

WINDOW_MSGPACK = "application/vnd.dextouch.window+msgpack"
# Committed content is immutable but may be deleted: clients must revalidate.
CACHE_CONTROL = "private, no-cache"
IfNoneMatch = Annotated[str | None, Header(alias="if-none-match")]
STREAMS: dict[schemas.ActionKind, str] = {"measured": "action", "commanded": "action_commanded"}
MAX_STEPS = 10_000
GAP_PERIODS = 1.5
MAX_GAPS = 50
MAX_IMAGES = 240
QUALITY = 85
TOUCH_STREAMS = tuple(f"tactile_{side}" for side in SIDES)
Reader = episodes.EpisodeReader | episodes.RecordingReader
# Limits of one request: signals, and bytes of samples that are read for it.
MAX_SIGNALS = 16
MAX_READ_BYTES = 256 * 2**20
BLOCK_BYTES = 4 * 2**20
INTERVAL = "interval_ms"
MAX = "max"


def _answers(media_type: str) -> dict[str, Any]:
    """Responses of a route besides the problems that all routes can give."""
    return {"response_class": Response, "responses": {200: {"content": {media_type: {}}}, 304: {}}}


class WindowQuery(FrozenModel):
    """Query of a window; `cameras` is a comma-separated list, which may be empty.

    Images are optionally at half size in both axes, or gray with one channel.
    """

    start: int = Field(ge=0)
    num_steps: int = Field(default=17, ge=1)
    cameras: str = "camera_head"
    action_kind: schemas.ActionKind = "measured"
    half_size: bool = False
    gray: bool = False


class SpanQuery(FrozenModel):
    """Query of samples: start_ns ≤ t < stop_ns, by default all."""

    start_ns: int | None = None
    stop_ns: int | None = None


Span = Annotated[SpanQuery, Query()]


def content_router(store: episodes.EpisodeStore, settings: EpisodeStoreSettings) -> APIRouter:
    """Create the routes of single recordings and episodes; sizes are checked before reading."""
    router = APIRouter(prefix="/v1", dependencies=[MAY_READ])
    max_steps, max_bytes = settings.max_window_steps, settings.max_answer_bytes

    @router.get("/recordings/{recording_id}/attributes", tags=["recordings"])
    def get_recording_attributes(recording_id: str) -> schemas.RecordingAttributes:
        """Attributes of a finished recording."""
        return store.recording(recording_id).attributes

    @router.get(
        "/recordings/{recording_id}/streams/{stream}", tags=["recordings"], **_answers(MSGPACK)
    )
    def get_recording_samples(
        recording_id: str, stream: str, span: Span, known: IfNoneMatch = None
    ) -> Response:
        """Samples of a finished recording with start_ns ≤ t_host_ns < stop_ns, as msgpack."""
        reader = store.recording(recording_id)
        read = partial(_samples, reader, stream, span, max_bytes)
        return response(etag_of(reader, stream, span), known, read)

    @router.get("/episodes/{episode_id}", tags=["episodes"])
    def get_episode(episode_id: str) -> schemas.EpisodeDetail:
        """Attributes of an episode."""
        reader = store.open(episode_id)
        return schemas.EpisodeDetail(
            attributes=reader.attributes,
            num_steps=reader.num_steps,
            content_sha256=reader.content_sha256,
        )

    @router.get("/episodes/{episode_id}/windows", tags=["episodes"], **_answers(WINDOW_MSGPACK))
    def get_episode_window(
        episode_id: str, query: Annotated[WindowQuery, Query()], known: IfNoneMatch = None
    ) -> Response:
        """Window of the model grid as msgpack (`dextouch.episodes.decode_window`)."""
        text = f"window: got {query.num_steps} steps, expected at most {max_steps}"
        _check_limit(query.num_steps, max_steps, text)
        reader = store.open(episode_id)
        read = partial(_window, reader, query, max_bytes)
        return response(etag_of(reader, "window", query), known, read, WINDOW_MSGPACK)

    @router.get("/episodes/{episode_id}/streams/{stream}", tags=["episodes"], **_answers(MSGPACK))
    def get_episode_samples(
        episode_id: str, stream: str, span: Span, known: IfNoneMatch = None
    ) -> Response:
        """Samples with start_ns ≤ t_ref_ns < stop_ns as msgpack."""
        reader = store.open(episode_id)
        read = partial(_samples, reader, stream, span, max_bytes)
        return response(etag_of(reader, stream, span), known, read)

    return router


def response(
    etag: str, known: str | None, read: Callable[[], bytes], media_type: str = MSGPACK
) -> Response:
    """Response with ETag; 304 without a body if the client has it already."""
    headers = {"etag": etag, "cache-control": CACHE_CONTROL}
    if is_known(etag, known):
        return Response(status_code=304, headers=headers)
    return Response(read(), media_type=media_type, headers=headers)


def _window(reader: episodes.EpisodeReader, query: WindowQuery, max_bytes: int) -> bytes:
    cameras = tuple(name for name in query.cameras.split(",") if name)
    form = episodes.ImageForm(half_size=query.half_size, gray=query.gray)
    # An unknown camera is refused by the reader.
    known_cameras = [reader.streams[name] for name in cameras if name in reader.streams]
    step_bytes = sum(
        prod(form.shape(stream.shape)) for stream in known_cameras if len(stream.shape) == 3
    )
    allowed = max_bytes // max(step_bytes, 1)
    text = (
        f"window: {query.num_steps} steps hold {query.num_steps * step_bytes} bytes of images, "
        f"expected at most {max_bytes}, which are {allowed} steps; ask for fewer steps or cameras"
    )
    _check_limit(query.num_steps, allowed, text)
    window = reader.window(
        query.start, query.num_steps, cameras=cameras, action_kind=query.action_kind, form=form
    )
    return episodes.encode_window(window)


def _samples(reader: Reader, stream: str, span: SpanQuery, max_bytes: int) -> bytes:
    count = reader.count(stream, span.start_ns, span.stop_ns)
    sample_bytes = reader.streams[stream].sample_bytes() + 24
    allowed = max_bytes // sample_bytes
    text = (
        f"{stream}: {count} samples are {count * sample_bytes} bytes, expected at most "
        f"{max_bytes}, which are {allowed} samples; ask for a shorter time"
    )
    _check_limit(count, allowed, text)
    # The fields of both kinds of answers are arrays: stamps, then values.
    return pack({"stream": stream}, vars(reader.read(stream, span.start_ns, span.stop_ns)))


def _check_limit(got: int, expected: int, text: str) -> None:
    if got > expected:
        raise LimitExceededError(text, got=got, expected=expected)


def etag_of(reader: Reader, what: str, query: BaseModel) -> str:
    """ETag of content and query; valid forever since committed groups are immutable."""
    text = f"{ANSWER_VERSION} {reader.content_sha256} {what} {query.model_dump_json()}"
    return f'"{hashlib.sha256(text.encode()).hexdigest()[:40]}"'


def is_known(etag: str, known: str | None) -> bool:
    """Whether an ETag is listed in an `If-None-Match` header."""
    if known is None:
        return False
    tags = {tag.strip().removeprefix("W/") for tag in known.split(",")}
    return etag in tags or "*" in tags


class RobotHandsQuery(FrozenModel):
    """Query of robot hands: start_ns ≤ t < stop_ns, and which actions."""

    start_ns: int
    stop_ns: int
    action_kind: schemas.ActionKind = "measured"


def robot_hands(reader: episodes.EpisodeReader, query: RobotHandsQuery) -> bytes:
    """Both robot hands of the actions in a span, by forward kinematics, as msgpack.

    Arrays: `t_ns` [n]; for each side `SIDE_points_world_m` [n, 5, 4, 3], knuckle, PIP, DIP and tip
    from thumb to little finger; `T_world_wrist_left`, `T_world_wrist_right` and
    `T_world_camera_head` [n, 4, 4].
    Raises UnknownNameError without such actions, InvalidInputError for those of another hand, and
    LimitExceededError for too many steps.
    """
    stream = STREAMS[query.action_kind]
    count = reader.count(stream, query.start_ns, query.stop_ns)
    text = f"the span holds {count} steps, expected at most {MAX_STEPS}; ask for a shorter time"
    _check_limit(count, MAX_STEPS, f"{stream}: {text}")
    about = reader.attributes
    if reader.streams[stream].shape != (ACTION_DIM,):
        raise InvalidInputError(
            f"{stream}: got values of shape {reader.streams[stream].shape}, "
            f"expected ({ACTION_DIM},)"
        )
    if _is_of_human_hand(reader):
        raise InvalidInputError(
            f"episode {about.episode_id!r}: the actions of a person in the twin hold the joint "
            "angles of the human hand, expected those of the robot hand; align its recording"
        )
    read = reader.read(stream, query.start_ns, query.stop_ns)
    return pack({"action_kind": query.action_kind}, _points(reader, read.t_ref_ns, read.values))


def _is_of_human_hand(reader: episodes.EpisodeReader) -> bool:
    return (reader.attributes.domain, reader.attributes.origin) == ("human", "twin")


def _points(
    reader: episodes.EpisodeReader, t_ref_ns: np.ndarray, actions: np.ndarray
) -> dict[str, np.ndarray]:
    arrays: dict[str, Any] = {"t_ns": t_ref_ns}
    if not len(t_ref_ns):
        return arrays
    anchor = reader.attributes.anchor.to_poses()
    where = f"actions of episode {reader.item_id!r}"
    hands = poses_from_actions(actions, anchor, where=where)
    for side in SIDES:
        Ts_world_wrist = getattr(hands, f"Ts_world_wrist_{side}")
        points_wrist = RobotHand(side).chain_points_m(getattr(hands, f"joints_{side}_rad"))
        R, t = Ts_world_wrist[:, None, None, :3, :3], Ts_world_wrist[:, None, None, :3, 3]
        arrays[f"{side}_points_world_m"] = (R @ points_wrist[..., None])[..., 0] + t
        arrays[f"T_world_wrist_{side}"] = Ts_world_wrist
    return arrays | {"T_world_camera_head": hands.Ts_world_camera_head}


class ImagesQuery(SpanQuery):
    """Query of images: start_ns ≤ t < stop_ns, optionally at half size in both axes."""

    half_size: bool = False


Images = Annotated[ImagesQuery, Query()]


# Differences of two fit int64; until the year 2116. Beyond it is "from the start", "to the end".
_MOST_NS: Final = 2**62 - 1
Nanoseconds = Annotated[int, AfterValidator(lambda ns: max(-_MOST_NS, min(ns, _MOST_NS)))]


class SignalsQuery(FrozenModel):
    """Query of signals, a comma-separated list, in `points` bins of [start_ns, stop_ns).

    `STREAM` is the sum of a sample's values, `STREAM.max` the largest of them, `STREAM.K` its value
    K, `STREAM.interval_ms` the time since the sample before.
    """

    names: str = Field(min_length=1, max_length=2000)
    start_ns: Nanoseconds
    stop_ns: Nanoseconds
    points: int = Field(default=600, ge=1, le=4000)


Signals = Annotated[SignalsQuery, Query()]


def playback_router(store: episodes.EpisodeStore, settings: EpisodeStoreSettings) -> APIRouter:
    """Create the routes below /v1/playback; sizes are checked before reading."""
    router = APIRouter(prefix="/v1/playback", dependencies=[MAY_READ], tags=["playback"])

    @router.get("/{kind}/{item_id}")
    def get_playback(kind: schemas.ItemKind, item_id: str) -> schemas.Playback:
        """What can be played of an item: its streams with their extents and longest gaps."""
        return playback_of(store.open_item(kind, item_id))

    @router.get("/{kind}/{item_id}/images/{camera}", **_answers(MSGPACK))
    def get_playback_images(
        kind: schemas.ItemKind, item_id: str, camera: str, query: Images, known: IfNoneMatch = None
    ) -> Response:
        """JPEG images of a span: arrays `t_ns`, `num_bytes` of each, and `data`, one by one."""
        reader = store.open_item(kind, item_id)
        read = partial(_images, reader, camera, query, settings.max_answer_bytes)
        return response(etag_of(reader, f"jpeg {camera}", query), known, read)

    @router.get("/{kind}/{item_id}/signals", **_answers(MSGPACK))
    def get_playback_signals(
        kind: schemas.ItemKind, item_id: str, query: Signals, known: IfNoneMatch = None
    ) -> Response:
        """Lowest and highest value per bin of time: arrays `NAME/low`, `NAME/high` [points]."""
        reader = store.open_item(kind, item_id)
        return response(
            etag_of(reader, "signals", query), known, lambda: reduce_signals(reader, query)
        )

    @router.get("/episode/{item_id}/robot_hands", **_answers(MSGPACK))
    def get_playback_robot_hands(
        item_id: str, query: Annotated[RobotHandsQuery, Query()], known: IfNoneMatch = None
    ) -> Response:
        """Points of both robot hands in the world, from the actions of a span."""
        reader = store.open(item_id)
        read = partial(robot_hands, reader, query)
        return response(etag_of(reader, "robot_hands", query), known, read)

    return router


def playback_of(reader: Reader) -> schemas.Playback:
    """Facts about an item for a player; reads the stamps of every stream."""
    streams = tuple(_played(reader, stream) for stream in reader.streams.values())
    firsts = [stream.first_ns for stream in streams if stream.first_ns is not None]
    lasts = [stream.last_ns for stream in streams if stream.last_ns is not None]
    about = reader.attributes
    names = ("task", "instruction", "domain", "station", "operator", "success", "recovered")
    shared = {name: getattr(about, name) for name in (*names, "lineage")}
    span = {"start_ns": min(firsts, default=0), "stop_ns": max(lasts, default=0)}
    if isinstance(reader, episodes.EpisodeReader):
        of_episode = reader.attributes
        origin_ns = of_episode.quality.get("origin_after_start_ns")
        own = {
            "kind": "episode",
            **{name: getattr(of_episode, name) for name in ("origin", "absent", "model_rate_hz")},
            "at": of_episode.created_at,
            "num_steps": reader.num_steps,
            "origin_after_start_ns": None if origin_ns is None else round(origin_ns),
        }
    else:
        own = {"kind": "recording", "origin": "recorded", "at": reader.attributes.started_at}
        own["started_t_host_ns"] = reader.attributes.started_t_host_ns
    return schemas.Playback.model_validate(
        shared | span | own | {"id": reader.item_id, "streams": streams}
    )


def _played(reader: Reader, stream: StreamDescriptor) -> schemas.PlayedStream:
    stamps_ns = reader.stamps_ns(stream.name)
    steps_ns = np.diff(stamps_ns)
    gaps = np.flatnonzero(steps_ns > GAP_PERIODS * stream.period_ns())
    longest = np.sort(gaps[np.argsort(steps_ns[gaps], kind="stable")[-MAX_GAPS:]])
    calibration, num_taxels = reader.attributes.calibration, stream.tactile_layout.num_taxels
    spans = episodes.interpolated_spans(calibration) if stream.name.startswith("action") else []
    taxels = np.zeros(0, dtype=np.int64)
    if stream.name in TOUCH_STREAMS:
        measured = episodes.measured_taxels(calibration, num_taxels)
        taxels = np.flatnonzero(~measured[TOUCH_STREAMS.index(stream.name)])
    is_action = stream.name in STREAMS.values() and stream.shape == (ACTION_DIM,)
    components = (
        action_names(has_robot_joints=not _is_of_human_hand(reader))
        if is_action and isinstance(reader, episodes.EpisodeReader)
        else ()
    )
    return schemas.PlayedStream(
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
        interpolated=tuple(
            schemas.InterpolatedSpan(part=part, start_ns=start_ns, stop_ns=stop_ns)
            for part, start_ns, stop_ns in spans
        ),
        unmeasured_taxels=tuple(taxels.tolist()),
        components=tuple(components),
        layout=stream.layout,
    )


def _images(reader: Reader, camera: str, query: ImagesQuery, max_bytes: int) -> bytes:
    count = reader.count(camera, query.start_ns, query.stop_ns)
    descriptor = reader.streams[camera]
    if descriptor.kind != "image":
        raise InvalidInputError(f"images: {camera!r} is a stream of kind {descriptor.kind!r}")
    is_colour = len(descriptor.shape) == 3
    form = episodes.ImageForm(half_size=query.half_size and is_colour)
    image_bytes = int(np.prod(form.shape(descriptor.shape)))
    allowed = max(1, min(MAX_IMAGES, max_bytes // image_bytes))
    text = f"the span holds {count} images, expected at most {allowed}; ask for a shorter time"
    _check_limit(count, allowed, f"{camera}: {text}")
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
        encoded = [encode_jpeg(_in_colour(picture), quality=QUALITY) for picture in pictures]
    return pack(
        {"camera": camera},
        {
            "t_ns": stamps_ns[indices],
            "num_bytes": np.array([len(one) for one in encoded], dtype=np.int64),
            "data": np.frombuffer(b"".join(encoded), dtype=np.uint8),
        },
    )


def _in_colour(picture: np.ndarray) -> np.ndarray:
    """An image with three channels; one of 16 bits relative to its largest value."""
    if picture.ndim == 3:
        return picture
    if picture.dtype != np.uint8:
        largest = max(1, int(picture.max()))
        picture = (picture.astype(np.uint64) * 255 // largest).astype(np.uint8)
    return np.repeat(picture[..., None], 3, axis=-1)


def reduce_signals(reader: Reader, query: SignalsQuery) -> bytes:
    """Lowest and highest values of every signal, float32 [points] as msgpack; NaN without samples.

    Raises UnknownNameError without the stream, InvalidInputError without the value, for images or
    an empty span, and LimitExceededError for too many signals or samples.
    """
    names = list(dict.fromkeys(query.names.split(",")))
    text = f"signals: got {len(names)}, expected at most {MAX_SIGNALS}"
    _check_limit(len(names), MAX_SIGNALS, text)
    if query.stop_ns <= query.start_ns:
        raise InvalidInputError(
            f"signals: got the span {query.start_ns} … {query.stop_ns}, expected start < stop"
        )
    arrays = {}
    left_bytes = MAX_READ_BYTES
    for name in names:
        stream, _, what = name.partition(".")
        # Refuses unknown streams.
        count = reader.count(stream, query.start_ns, query.stop_ns)
        left_bytes -= 0 if what == INTERVAL else count * reader.streams[stream].sample_bytes()
        if left_bytes < 0:
            raise LimitExceededError(
                f"signals: the span holds more than {MAX_READ_BYTES} bytes of samples; "
                "ask for a shorter time or fewer signals",
                expected=MAX_READ_BYTES,
            )
        low, high = _reduced(reader, stream, what, query)
        arrays[f"{name}/low"], arrays[f"{name}/high"] = low, high
    return pack({"start_ns": query.start_ns, "stop_ns": query.stop_ns}, arrays)


def _reduced(
    reader: Reader, stream: str, what: str, query: SignalsQuery
) -> tuple[np.ndarray, np.ndarray]:
    low = np.full(query.points, np.inf)
    high = np.full(query.points, -np.inf)
    span_ns = query.stop_ns - query.start_ns
    for t_ns, values in _blocks(reader, stream, what, query):
        is_known = np.isfinite(values)
        bins = ((t_ns - query.start_ns)[is_known] * (query.points / span_ns)).astype(np.int64)
        bins = np.minimum(bins, query.points - 1)
        np.minimum.at(low, bins, values[is_known])
        np.maximum.at(high, bins, values[is_known])
    is_empty = low > high
    low[is_empty] = high[is_empty] = np.nan
    return low.astype(np.float32), high.astype(np.float32)


def _blocks(
    reader: Reader, stream: str, what: str, query: SignalsQuery
) -> Iterator[tuple[np.ndarray, Float64[np.ndarray, " n"]]]:
    """Stamps and values of a signal in the span, a few MiB of samples at a time."""
    stamps_ns = reader.stamps_ns(stream)
    first, stop = (int(stamps_ns.searchsorted(t)) for t in (query.start_ns, query.stop_ns))
    if what == INTERVAL:
        before = max(first, 1)
        yield stamps_ns[before:stop], np.diff(stamps_ns[before - 1 : stop]) / 1e6
        return
    descriptor = reader.streams[stream]
    reduced = _reduction(descriptor, what)
    rows = max(1, BLOCK_BYTES // descriptor.sample_bytes())
    for low in range(first, stop, rows):
        high = min(low + rows, stop)
        samples = reader.values(stream, low, high).reshape(high - low, -1).astype(np.float64)
        yield stamps_ns[low:high], reduced(samples)


def _reduction(descriptor: StreamDescriptor, what: str) -> Callable[[np.ndarray], np.ndarray]:
    """The signal of flat samples [n, size]."""
    size = int(np.prod(descriptor.shape))
    if descriptor.kind == "image":
        raise InvalidInputError(
            f"signal {descriptor.name}: is an image stream, whose only signal is "
            f"{descriptor.name}.{INTERVAL}"
        )
    if not what:
        return lambda samples: samples.sum(axis=1)
    if what == MAX:
        return lambda samples: samples.max(axis=1)
    if not (what.isdecimal() and what.isascii() and len(what) < 7 and int(what) < size):
        raise InvalidInputError(
            f"signal {descriptor.name}: got {what[:40]!r}, expected {INTERVAL}, {MAX} or an index "
            f"in 0 … {size - 1}"
        )
    index = int(what)
    return lambda samples: samples[:, index]
