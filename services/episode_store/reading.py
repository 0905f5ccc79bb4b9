"""Ids and times in, msgpack of windows and samples out, within the bounds of one answer."""

from math import prod

import numpy as np

from dextouch.episodes import EpisodeReader, EpisodeStore, RecordingReader
from dextouch.episodes.window_codec import encode_window
from dextouch.errors import LimitExceededError
from dextouch.schemas.episodes import EpisodeDetail
from dextouch.schemas.recordings import RecordingAttributes
from dextouch.schemas.rollouts import ActionKind
from dextouch.streams.packing import pack

MSGPACK = "application/msgpack"


class StoreReader:
    """What the routes read, each answer bounded.

    Args:
        store: that is read.
        max_window_steps: longest window.
        max_answer_bytes: largest answer, before it is read.
    """

    def __init__(
        self, store: EpisodeStore, *, max_window_steps: int, max_answer_bytes: int
    ) -> None:
        self._store = store
        self._max_steps, self._max_bytes = max_window_steps, max_answer_bytes

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

    def window(
        self,
        episode_id: str,
        start: int,
        num_steps: int,
        *,
        cameras: tuple[str, ...],
        action_kind: ActionKind,
    ) -> bytes:
        """One window.

        Raises:
            LimitExceededError: more steps or bytes of images than allowed.
        """
        if num_steps > self._max_steps:
            raise LimitExceededError(
                f"window: got {num_steps} steps, expected at most {self._max_steps}"
            )
        reader = self._store.open(episode_id)
        known = [reader.streams[camera] for camera in cameras if camera in reader.streams]
        num_bytes = num_steps * sum(prod(descriptor.shape) for descriptor in known)
        if num_bytes > self._max_bytes:
            raise LimitExceededError(
                f"window: {num_steps} steps hold {num_bytes} bytes of images, expected at most "
                f"{self._max_bytes}; ask for fewer steps or cameras"
            )
        return encode_window(
            reader.window(start, num_steps, cameras=cameras, action_kind=action_kind)
        )

    def episode_samples(
        self, episode_id: str, stream: str, start_ns: int | None, stop_ns: int | None
    ) -> bytes:
        """Stamps and values of one stream of an episode."""
        reader = self._store.open(episode_id)
        self._check_size(reader, stream, start_ns, stop_ns)
        data = reader.read(stream, start_ns, stop_ns)
        return pack({"stream": stream}, {"t_ref_ns": data.t_ref_ns, "values": data.values})

    def recording_samples(
        self, recording_id: str, stream: str, start_ns: int | None, stop_ns: int | None
    ) -> bytes:
        """Stamps and values of one stream of a recording."""
        reader = self._store.recording(recording_id)
        self._check_size(reader, stream, start_ns, stop_ns)
        batch = reader.read(stream, start_ns, stop_ns)
        arrays = {
            "t_host_ns": batch.t_host_ns,
            "t_device_ns": batch.t_device_ns,
            "sequence": batch.sequence,
            "values": batch.values,
        }
        return pack({"stream": stream}, arrays)

    def _check_size(
        self,
        reader: EpisodeReader | RecordingReader,
        stream: str,
        start_ns: int | None,
        stop_ns: int | None,
    ) -> None:
        count = reader.count(stream, start_ns, stop_ns)
        descriptor = reader.streams[stream]
        num_bytes = count * (prod(descriptor.shape) * np.dtype(descriptor.dtype).itemsize + 24)
        if num_bytes > self._max_bytes:
            raise LimitExceededError(
                f"{stream}: {count} samples are {num_bytes} bytes, expected at most "
                f"{self._max_bytes}; ask for a shorter time"
            )
