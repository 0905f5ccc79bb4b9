"""Writer of a new episode or recording, stream by stream, which appears atomically on commit."""

import hashlib
import os
import shutil
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from itertools import accumulate
from pathlib import Path

import google_crc32c
import numpy as np
from pydantic import BaseModel

from dextouch.episodes.files import (
    GroupFiles,
    copy_files,
    disk_errors,
    make_held_folder,
    write_file,
)
from dextouch.episodes.format import (
    COMMIT_FILE,
    GOP_IMAGES,
    GROUP_IMAGES,
    METADATA_FILE,
    STAMPS,
    ArrayEntry,
    Attributes,
    ImageCodec,
    Kind,
    array_files,
    attributes_id,
    decode_commit,
    image_codec,
    index_name,
    kind_of,
    stream_arrays,
    stream_content,
)
from dextouch.episodes.image_codecs import (
    GopEncoder,
    VideoSettings,
    check_video_size,
    is_keyframe,
    pack_group,
)
from dextouch.episodes.shards import ShardWriter
from dextouch.episodes.staging import commit_stage, publish
from dextouch.errors import (
    ConflictError,
    InvalidInputError,
    NonFiniteError,
    ShapeError,
    StorageError,
    UnknownNameError,
)
from dextouch.images import DEFAULT_QUALITY, encode_jpeg
from dextouch.schemas import StreamContent
from dextouch.streams import (
    ENCODED_UNITS,
    MAX_STREAMS,
    NO_DEVICE_TIME,
    NO_SEQUENCE,
    SampleBatch,
    StreamDescriptor,
    check_encoded_image,
)


class EpisodeWriter:
    """Writes one episode or recording to a stage and publishes it on commit.

    Use it as a context manager (from `EpisodeStore.writer`): leaving it normally commits. After an
    exception, Ctrl-C included, nothing is left, and of a killed writer only a stage that
    `EpisodeStore.sweep` removes. A take is kept by its spool (`dextouch.episodes.spool`) until it
    is committed. Streams listed in the attributes are added at the start.
    """

    def __init__(self, *, stage: Path, target: Path, attributes: Attributes) -> None:
        self._stage, self._target = stage, target
        self._attributes, self._kind = attributes, kind_of(attributes)
        self._streams: dict[str, StreamWriter] = {}
        self._taken: bytes | None = None
        with disk_errors(f"create {stage}"):
            # Locked as long as the writer lives, so that no sweep takes the stage for abandoned.
            self._lock = make_held_folder(stage)
        try:
            for descriptor in attributes.streams:
                self.add_stream(descriptor)
        except BaseException:
            self._leave()
            raise

    def add_stream(self, descriptor: StreamDescriptor) -> None:
        """Add a stream.

        Raises ConflictError if one of its arrays has the name of another, InvalidInputError beyond
        MAX_STREAMS, or for a `jpeg` or `h264` stream that does not hold uint8 [h, w, 3], with even
        sides for `h264`.
        """
        if len(self._streams) >= MAX_STREAMS:
            raise InvalidInputError(
                f"{attributes_id(self._attributes)}: stream {descriptor.name!r} exceeds the limit, "
                f"expected at most {MAX_STREAMS} streams; put some into one stream of a larger "
                f"shape, or write a second {self._kind}"
            )
        if descriptor.unit in ENCODED_UNITS and (
            descriptor.dtype != "uint8" or len(descriptor.shape) != 3 or descriptor.shape[2] != 3
        ):
            raise InvalidInputError(
                f"{descriptor.name}: got {descriptor.dtype} {descriptor.shape}, "
                f"expected uint8 [h, w, 3] for unit {descriptor.unit!r}"
            )
        taken = {name for stream in self._streams.values() for name in stream.arrays}
        for name in stream_arrays(descriptor, self._kind):
            if name in taken:
                raise ConflictError(f"stream {descriptor.name!r}: array {name!r} exists already")
        self._streams[descriptor.name] = StreamWriter(self._stage, descriptor, self._kind)

    def append(
        self,
        name: str,
        *,
        values: np.ndarray,
        t_ref_ns: np.ndarray | None = None,
        t_host_ns: np.ndarray | None = None,
        t_device_ns: np.ndarray | None = None,
        sequence: np.ndarray | None = None,
    ) -> None:
        """Append a block of samples to an added stream.

        Values are `[n, *shape]` of the stream's dtype; finite in episodes. For the units `jpeg` and
        `h264` they are uint8 images [n, h, w, 3], or an object array of encoded images (bytes),
        stored unchanged. Episodes need exactly `t_ref_ns` [n], strictly increasing; recordings
        `t_host_ns` [n], non-decreasing, and where there are any `t_device_ns` and `sequence`, with
        NO_DEVICE_TIME and NO_SEQUENCE where absent.

        Raises:
            UnknownNameError: no such stream.
            InvalidInputError: stamps of the other kind or out of order, or unfit values.
            StorageFullError: the disk is full.
            StorageError: an earlier block of the stream was interrupted.
        """
        if name not in self._streams:
            raise UnknownNameError("stream", name, list(self._streams))
        given = {
            "t_ref_ns": t_ref_ns,
            "t_host_ns": t_host_ns,
            "t_device_ns": t_device_ns,
            "sequence": sequence,
        }
        stamps = {key: np.asarray(column) for key, column in given.items() if column is not None}
        values = np.asarray(values)
        if self._kind == "recording":
            blank = np.full(len(values), NO_DEVICE_TIME, dtype=np.int64)
            stamps.setdefault("t_device_ns", blank)
            stamps.setdefault("sequence", np.full(len(values), NO_SEQUENCE, dtype=np.int64))
        if set(stamps) != set(STAMPS[self._kind]):
            raise InvalidInputError(
                f"{name}: got stamps {sorted(stamps)}, expected {list(STAMPS[self._kind])} "
                f"in a block of {self._kind}"
            )
        self._streams[name].append(values, stamps)

    def set_attributes(self, attributes: Attributes) -> None:
        """Replace the attributes, for values known only at the end (success, ledger).

        Raises InvalidInputError for another kind or id than the writer was opened for.
        """
        if type(attributes) is not type(self._attributes) or attributes_id(
            attributes
        ) != attributes_id(self._attributes):
            raise InvalidInputError(
                f"attributes: got {attributes_id(attributes)!r}, expected the same kind and id "
                f"as {attributes_id(self._attributes)!r}"
            )
        self._attributes = attributes

    def add_remark(self, name: str, remark: BaseModel) -> None:
        """Put a remark, such as `review.json`, beside the content: it appears with the item."""
        with disk_errors(f"write {name} of {self._target.name}"):
            write_file(self._stage / name, remark.model_dump_json().encode())

    def take_files(self, source: GroupFiles, *, metadata: bytes, commit: bytes, link: bool) -> None:
        """Take the arrays of a committed group as they are, in place of streams.

        `metadata` and `commit` are the files of these names. With `link` the files of a local group
        are shared with it, where the file system can: committed ones are never written again.
        """
        record, _ = decode_commit(commit, what=source.item_id)
        copy_files(source, sorted(array_files(record.arrays)), self._stage, link=link)
        with disk_errors(f"copy {source.item_id}"):
            write_file(self._stage / METADATA_FILE, metadata)
        self._taken = commit

    def __enter__(self) -> "EpisodeWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._commit()
        finally:
            self._leave()

    def _leave(self) -> None:
        """Close the files and remove the stage, which a commit has moved away."""
        with ExitStack() as stack:
            stack.callback(os.close, self._lock)
            stack.callback(shutil.rmtree, self._stage, ignore_errors=True)
            for stream in self._streams.values():
                stack.callback(stream.close)

    def _commit(self) -> None:
        if self._taken is not None:
            with disk_errors(f"commit {self._target.name}"):
                write_file(self._stage / COMMIT_FILE, self._taken)
            publish(self._stage, self._target)
            return
        if not self._streams:
            raise InvalidInputError(f"{attributes_id(self._attributes)}: has no stream")
        entries = {
            name: entry
            for stream in self._streams.values()
            for name, entry in stream.finish().items()
        }
        descriptors = tuple(stream.descriptor for stream in self._streams.values())
        attributes = self._attributes.model_copy(update={"streams": descriptors})
        commit_stage(self._stage, self._target, attributes, entries)


MAX_WAITING_IMAGES = 32
Stamps = Mapping[str, np.ndarray]


class StreamWriter:
    """Writes values and stamps of one stream, after validating every block.

    Plain images of a `jpeg` or `h264` stream are encoded in a background thread.
    """

    def __init__(self, stage: Path, descriptor: StreamDescriptor, kind: Kind) -> None:
        self.descriptor, self._kind = descriptor, kind
        self._last_stamp_ns: int | None = None
        # Arrival stamps may repeat: a device can hand over several samples at once.
        self._least_step_ns = 1 if kind == "episode" else 0
        # Whether values are numbers or encoded images, decided by the first block.
        self._plain: bool | None = None
        # Whether a block was interrupted, after which arrays are misaligned.
        self._is_broken = False
        self._dtype = descriptor.numpy_dtype()
        codec = image_codec(descriptor)
        self._images = None if codec is None else _EncodedImages(descriptor, codec)
        self._queue: _ImageQueue | None = None
        entries = stream_arrays(descriptor, kind)
        self.arrays = {name: ShardWriter(stage, name, entry) for name, entry in entries.items()}

    def append(self, values: np.ndarray, stamps: Stamps) -> None:
        """Append a block with all stamps of the kind; raises as `EpisodeWriter.append`."""
        name = self.descriptor.name
        for stamp, column in stamps.items():
            if column.dtype != np.int64 or column.shape != (len(values),):
                raise ShapeError(
                    f"{name}: {stamp} is {column.dtype} {column.shape}, expected int64 "
                    f"[{len(values)}] like the values"
                )
        if not len(values):
            return
        # All checks come before the first write, so that a refused block has no effect.
        plain = self._images is None or values.dtype != object
        if self._plain is not None and self._plain != plain:
            raise InvalidInputError(
                f"{name}: got {'plain' if plain else 'encoded'} images after "
                f"{'encoded' if plain else 'plain'} ones, expected one kind in a stream"
            )
        if self._images is None or plain:
            self._check_values(values)
        else:
            self._images.check(values)
        self._check_order(stamps[STAMPS[self._kind][0]])
        self._plain = plain
        if self._images is None or (self._queue is None and values.dtype == object):
            self._write(values, stamps)
        else:
            # Once there is a queue, everything goes through it to keep the order.
            if self._queue is None:
                self._queue = _ImageQueue(self._write, name=name)
            self._queue.put(values, stamps)

    def _check_order(self, stamps_ns: np.ndarray) -> None:
        first_ns, last_ns, least = int(stamps_ns[0]), self._last_stamp_ns, self._least_step_ns
        # Compared, not subtracted: the difference of two extreme stamps can overflow.
        earlier, later = stamps_ns[:-1], stamps_ns[1:]
        wrong = later <= earlier if least else later < earlier
        if last_ns is not None and first_ns - last_ns < least:
            bad, step_ns = 0, first_ns - last_ns
        elif wrong.any():
            bad = int(wrong.argmax()) + 1
            step_ns = int(stamps_ns[bad]) - int(stamps_ns[bad - 1])
        else:
            self._last_stamp_ns = int(stamps_ns[-1])
            return
        raise InvalidInputError(
            f"{self.descriptor.name}: stamp goes from sample to sample by {step_ns} ns before "
            f"sample {bad} of this block, expected at least {least} ns; "
            "sort the samples or drop the repeated ones"
        )

    def _check_values(self, values: np.ndarray) -> None:
        descriptor = self.descriptor
        if values.dtype != self._dtype or values.shape[1:] != descriptor.shape:
            raise ShapeError(
                f"{descriptor.name}: got values {values.dtype} {values.shape}, expected "
                f"{descriptor.dtype} [n, {', '.join(map(str, descriptor.shape))}]"
            )
        # Recordings keep raw device values; consumers of episodes do not expect NaN.
        if self._kind == "episode" and values.dtype.kind == "f" and not np.isfinite(values).all():
            raise NonFiniteError(
                f"{descriptor.name}: {int((~np.isfinite(values)).sum())} values are NaN or "
                "infinite; leave invalid samples out of an episode"
            )

    def _write(self, values: np.ndarray, stamps: Stamps) -> None:
        self._check_unbroken()
        self._is_broken = True
        name = self.descriptor.name
        if self._images is None:
            self.arrays[name].append(values)
        else:
            images = [self._images.encoded(image) for image in values]
            for image in images:
                self.arrays[name].append_bytes(image)
            self.arrays[index_name(name)].append(self._images.index_rows(images))
        for stamp, column in stamps.items():
            self.arrays[f"{name}_{stamp}"].append(column)
        self._is_broken = False

    def _check_unbroken(self) -> None:
        if self._is_broken:
            raise StorageError(
                f"{self.descriptor.name}: a block was interrupted, and nothing can follow it; "
                "leave the writer's context, which removes what was written, and write it again"
            )

    def finish(self) -> dict[str, ArrayEntry]:
        """Complete all arrays and return their entries of the commit record.

        Raises StorageError if a block was written partially because of a disk failure.
        """
        if self._queue is not None:
            self._queue.drain()
        self._check_unbroken()
        name = self.descriptor.name
        entries = {name: array.finish() for name, array in self.arrays.items()}
        counts = {array: entry.shape[0] for array, entry in entries.items()}
        if self._images is not None:
            update = {"encoder": self._images.encoder, "sha256": self._images.digest.hexdigest()}
            entries[name] = entries[name].model_copy(update=update)
            del counts[name]  # of bytes
        if len(set(counts.values())) != 1:
            raise StorageError(f"{name}: a block was written partially ({counts}); write it again")
        return entries

    def close(self) -> None:
        """Stop the thread and close the files, discarding buffered samples."""
        if self._queue is not None:
            self._queue.stop()
        for array in self.arrays.values():
            array.close()


class _GroupDigest:
    """Digest of the encoded images of a stream, group by group."""

    def __init__(self, codec: ImageCodec) -> None:
        self._codec, self._sha256 = codec, hashlib.sha256()
        self._group: list[bytes] = []

    def add(self, image: bytes) -> None:
        self._group.append(image)
        if len(self._group) == GROUP_IMAGES[self._codec]:
            self._sha256.update(pack_group(self._codec, self._group))
            self._group = []

    def hexdigest(self) -> str:
        sha256 = self._sha256.copy()
        if self._group:
            sha256.update(pack_group(self._codec, self._group))
        return sha256.hexdigest()


class _EncodedImages:
    """Checks or encodes the images of a `jpeg` or `h264` stream, and says where each lies."""

    def __init__(self, descriptor: StreamDescriptor, codec: ImageCodec) -> None:
        self._descriptor, self._codec = descriptor, codec
        self._num_given = self._num_bytes = 0
        self._video: GopEncoder | None = None
        self.digest = _GroupDigest(codec)
        self.encoder: str | None = None
        if codec == "h264":
            check_video_size(*descriptor.shape[:2])

    def check(self, values: np.ndarray) -> None:
        name = self._descriptor.name
        for index, data in enumerate(values):
            number = self._num_given + index
            where = f"{name}: image {number}"
            check_encoded_image(self._descriptor, data, where=where)
            begins = number % GOP_IMAGES == 0
            if self._codec == "h264" and is_keyframe(data) != begins:
                raise InvalidInputError(
                    f"{where}: is {'no' if begins else 'a'} key frame; expected closed groups of "
                    f"{GOP_IMAGES} images, each beginning with one; decode and encode it again"
                )
        self._num_given += len(values)

    def encoded(self, image: np.ndarray | bytes) -> bytes:
        """The bytes of the next image, encoded here unless the caller gave them."""
        data = image if isinstance(image, bytes) else self._encode(image)
        self.digest.add(data)
        return data

    def index_rows(self, images: list[bytes]) -> np.ndarray:
        bounds = list(accumulate(map(len, images), initial=self._num_bytes))
        self._num_bytes = bounds[-1]
        crcs = map(google_crc32c.value, images)
        return np.array(list(zip(bounds[:-1], bounds[1:], crcs, strict=True)), dtype=np.int64)

    def _encode(self, image: np.ndarray) -> bytes:
        if self._codec == "jpeg":
            self.encoder = f"simplejpeg quality {DEFAULT_QUALITY}"
            return encode_jpeg(image)
        if self._video is None:
            height, width, _ = self._descriptor.shape
            rate_hz = self._descriptor.nominal_rate_hz
            self._video = GopEncoder(height, width, rate_hz=rate_hz, settings=VideoSettings())
            self.encoder = self._video.description
        return self._video.encode(image)


class _ImageQueue:
    """Writes blocks of images of a stream in order, in a background thread, with backpressure."""

    def __init__(self, write: Callable[[np.ndarray, Stamps], None], *, name: str) -> None:
        self._write = write
        self._waiting: deque[tuple[Future[None], int]] = deque()
        self._spare: deque[np.ndarray] = deque(maxlen=MAX_WAITING_IMAGES)
        self._num_images = 0
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix=f"encode-{name}")

    def put(self, values: np.ndarray, stamps: Stamps) -> None:
        """Queue a copy of a block; re-raises the exception of an earlier one."""
        while self._waiting and self._waiting[0][0].done():
            self._take_oldest()
        # A block larger than the queue is accepted when the queue is empty.
        while self._waiting and self._num_images + len(values) > MAX_WAITING_IMAGES:
            self._take_oldest()
        kept = {name: column.copy() for name, column in stamps.items()}
        work = self._thread.submit(self._hand_on, self._copy(values), kept)
        self._waiting.append((work, len(values)))
        self._num_images += len(values)

    def drain(self) -> None:
        while self._waiting:
            self._take_oldest()

    def stop(self) -> None:
        self._thread.shutdown(cancel_futures=True)

    def _copy(self, values: np.ndarray) -> np.ndarray:
        if values.dtype == object:
            return values.copy()
        # Reused buffers: page faults of fresh memory cost more than copying the image.
        while self._spare:
            spare = self._spare.pop()
            if spare.shape == values.shape:
                np.copyto(spare, values)
                return spare
        return values.copy()

    def _hand_on(self, values: np.ndarray, stamps: Stamps) -> None:
        self._write(values, stamps)
        if values.dtype != object:
            self._spare.append(values)

    def _take_oldest(self) -> None:
        done, num_images = self._waiting.popleft()
        self._num_images -= num_images
        done.result()


class ContentDigest:
    """Digest of the samples of one stream of a recording, batch by batch.

    By it a station proves that a recording has all of its take: it is made of what a commit record
    says of the stream (`stream_content`), and a station computes it from its spool.
    Images of `jpeg` and `h264` streams are encoded, as in a spool.
    """

    def __init__(self, descriptor: StreamDescriptor) -> None:
        codec = image_codec(descriptor)
        self._dtype = descriptor.numpy_dtype().newbyteorder("<")
        self._images = None if codec is None else _GroupDigest(codec)
        self._numbers = hashlib.sha256()
        self._stamps = [hashlib.sha256() for _ in STAMPS["recording"]]
        self._num_samples = 0

    def add(self, batch: SampleBatch) -> None:
        """Add the next samples of the stream."""
        self._num_samples += len(batch)
        for column, stamp in zip(self._stamps, STAMPS["recording"], strict=True):
            column.update(getattr(batch, stamp).astype("<i8").tobytes())
        if self._images is None:
            self._numbers.update(batch.values.astype(self._dtype, order="C", copy=False).data)
            return
        for image in batch.values:
            self._images.add(image)

    def content(self) -> StreamContent:
        """What was added so far."""
        columns = (self._numbers if self._images is None else self._images, *self._stamps)
        return stream_content(self._num_samples, [column.hexdigest() for column in columns])
