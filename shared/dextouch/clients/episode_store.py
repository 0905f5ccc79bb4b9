"""HTTP client of the episode store: uploads, queries, windows and samples."""

import json
import ssl
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import TypeVar
from urllib.parse import quote

import httpx
import numpy as np
from pydantic import BaseModel, ValidationError

from dextouch import schemas
from dextouch.clients.http_link import service_address
from dextouch.episodes import StreamData, Window, decode_window
from dextouch.errors import DexTouchError, UnavailableError
from dextouch.streams import SampleBatch, StreamDescriptor, encode_batch, unpack

M = TypeVar("M", bound=BaseModel)
Scalar = str | int | float | bool | datetime
Query = Mapping[str, Scalar | Sequence[str] | None]
WINDOW_TYPE = "application/vnd.dextouch.window+msgpack"
MAX_ANSWER_BYTES = 128 * 2**20  # 17 steps of three cameras of 640 x 480 px have 47 MB
DEFAULT_TIMEOUT_S = 30.0  # chosen: for a busy store


class EpisodeStoreClient:
    """Client of one store service. Every call may be repeated after UnavailableError.

    `timeout_s` is of one request; `transport` may be an application in this process. Raises
    InvalidInputError for a URL that is none.
    """

    def __init__(
        self,
        url: str,
        api_key: str | None = None,
        *,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        service_address(url)
        headers = {"authorization": f"Bearer {api_key.strip()}"} if api_key else {}
        self._http = httpx.Client(
            base_url=url.rstrip("/"),
            headers=headers,
            timeout=timeout_s,
            transport=transport,
            # Authorities of the system, or of SSL_CERT_FILE, as for `HttpLink`; no proxy settings.
            verify=ssl.create_default_context(),
            trust_env=False,
        )

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> "EpisodeStoreClient":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def create(self, attributes: schemas.RecordingAttributes) -> schemas.RecordingStatus:
        """Begin an upload, or query the state of one that exists."""
        return self._model(
            schemas.RecordingStatus, "POST", "/v1/recordings", content=attributes.model_dump_json()
        )

    def status(self, recording_id: str) -> schemas.RecordingStatus:
        """The batch that each stream of an upload expects next."""
        return self._model(schemas.RecordingStatus, "GET", f"/v1/recordings/{_part(recording_id)}")

    def send_batch(
        self,
        recording_id: str,
        descriptor: StreamDescriptor,
        batch: SampleBatch | bytes,
        *,
        number: int,
    ) -> schemas.BatchReceipt:
        """Send batch `number` of a stream; the store keeps it when this returns.

        Bytes are those of `dextouch.streams.frame_body` or `encode_batch`, sent as they are.
        """
        path = (
            f"/v1/recordings/{_part(recording_id)}/streams/{_part(descriptor.name)}"
            f"/batches/{number}"
        )
        if isinstance(batch, SampleBatch):
            batch = encode_batch(descriptor, batch, number=number)
        return self._model(schemas.BatchReceipt, "POST", path, content=batch)

    def finish(
        self,
        recording_id: str,
        num_batches: Mapping[str, int],
        *,
        success: bool | None = None,
        ledger: tuple[schemas.LedgerEntry, ...] = (),
        content: Mapping[str, schemas.StreamContent] | None = None,
    ) -> schemas.RecordingStatus:
        """Finish an upload with its number of batches per stream; the recording becomes visible.

        With `content` (`dextouch.episodes.ContentDigest`) the store compares all samples, and the
        status has what it committed.
        """
        body = schemas.FinishRecording(
            num_batches=dict(num_batches),
            content=dict(content or {}),
            success=success,
            ledger=ledger,
        )
        path = f"/v1/recordings/{_part(recording_id)}/finish"
        return self._model(schemas.RecordingStatus, "POST", path, content=body.model_dump_json())

    def deletions_revision(self) -> str:
        """A text that changes with every permanent deletion."""
        path = "/v1/deletions/revision"
        return self._model(schemas.DeletionsRevision, "GET", path).revision

    def check_takes(self, spooled: schemas.CheckTakes) -> schemas.CheckedTakes:
        """Which takes of a station's spool were deleted permanently."""
        path, body = "/v1/deletions/check", spooled.model_dump_json()
        return self._model(schemas.CheckedTakes, "POST", path, content=body)

    def confirm_removal(self, removed: schemas.ConfirmRemoval) -> None:
        """Say that a station holds no deleted takes any more, except those that it names.

        Raises ConflictError if there was another deletion since `removed.revision`.
        """
        path, body = "/v1/deletions/confirm", removed.model_dump_json()
        self._model(schemas.DeletionsRevision, "POST", path, content=body)

    def recordings(self, **filters: Scalar | Sequence[str] | None) -> schemas.RecordingList:
        """Finished recordings that match every given filter, as in docs/wire_format.md.

        Such as `station="bench"`, `min_quality=["coverage:0.95"]`, `after="take-7"`.
        """
        return self._model(schemas.RecordingList, "GET", "/v1/recordings", query=filters)

    def recording_attributes(self, recording_id: str) -> schemas.RecordingAttributes:
        """Attributes of a finished recording."""
        path = f"/v1/recordings/{_part(recording_id)}/attributes"
        return self._model(schemas.RecordingAttributes, "GET", path)

    def recording_samples(
        self,
        recording_id: str,
        stream: str,
        *,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> SampleBatch:
        """Samples of a finished recording with start_ns ≤ t_host_ns < stop_ns."""
        path = f"/v1/recordings/{_part(recording_id)}/streams/{_part(stream)}"
        arrays = self._arrays(path, {"start_ns": start_ns, "stop_ns": stop_ns})
        return SampleBatch(
            arrays["t_host_ns"], arrays["t_device_ns"], arrays["sequence"], arrays["values"]
        )

    def episodes(self, **filters: Scalar | Sequence[str] | None) -> schemas.EpisodeList:
        """One page of the episodes that match every given filter, named as in `recordings`."""
        return self._model(schemas.EpisodeList, "GET", "/v1/episodes", query=filters)

    def hours(self, **filters: Scalar | Sequence[str] | None) -> schemas.CatalogHours:
        """Hours of the episodes that match, by task, domain and origin."""
        return self._model(schemas.CatalogHours, "GET", "/v1/catalog/hours", query=filters)

    def uploads(self, *, idle_s: float = 0.0) -> schemas.UploadList:
        """Unfinished uploads that have been idle for at least `idle_s`."""
        return self._model(schemas.UploadList, "GET", "/v1/uploads", query={"idle_s": idle_s})

    def expire_uploads(self, *, idle_s: float) -> schemas.UploadList:
        """Drop unfinished uploads that have been idle for at least `idle_s` and return them.

        The store refuses less than ten minutes.
        """
        body = json.dumps({"idle_s": idle_s})
        return self._model(schemas.UploadList, "POST", "/v1/uploads/expire", content=body)

    def episode(self, episode_id: str) -> schemas.EpisodeDetail:
        """Attributes of an episode."""
        return self._model(schemas.EpisodeDetail, "GET", f"/v1/episodes/{_part(episode_id)}")

    def episode_samples(
        self,
        episode_id: str,
        stream: str,
        *,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> StreamData:
        """Samples of an episode with start_ns ≤ t_ref_ns < stop_ns."""
        path = f"/v1/episodes/{_part(episode_id)}/streams/{_part(stream)}"
        arrays = self._arrays(path, {"start_ns": start_ns, "stop_ns": stop_ns})
        return StreamData(arrays["t_ref_ns"], arrays["values"])

    def window(
        self,
        episode_id: str,
        start: int,
        num_steps: int = 17,
        *,
        cameras: tuple[str, ...] = ("camera_head",),
        action_kind: schemas.ActionKind = "measured",
        half_size: bool = False,
    ) -> Window:
        """A window on the model grid, as `EpisodeReader.window` gives it."""
        query: Query = {
            "start": start,
            "num_steps": num_steps,
            "cameras": ",".join(cameras),
            "action_kind": action_kind,
            "half_size": half_size,
        }
        path = f"/v1/episodes/{_part(episode_id)}/windows"
        response = self._send("GET", path, query=query, accept=WINDOW_TYPE)
        return decode_window(response.content, max_bytes=MAX_ANSWER_BYTES)

    def _arrays(self, path: str, query: Query) -> dict[str, np.ndarray]:
        response = self._send("GET", path, query=query)
        return unpack(response.content, max_bytes=MAX_ANSWER_BYTES)[1]

    def _model(
        self,
        model: type[M],
        method: str,
        path: str,
        *,
        query: Query | None = None,
        content: bytes | str | None = None,
    ) -> M:
        response = self._send(method, path, query=query, content=content)
        try:
            return model.model_validate_json(response.content)
        except ValidationError as error:
            raise UnavailableError(
                f"episode store: {method} {path} answered in an unknown form ({error})"
            ) from error

    def _send(
        self,
        method: str,
        path: str,
        *,
        query: Query | None = None,
        content: bytes | str | None = None,
        accept: str = "*/*",
    ) -> httpx.Response:
        given = {
            key: value.isoformat() if isinstance(value, datetime) else value
            for key, value in (query or {}).items()
            if value is not None
        }
        headers = {"accept": accept}
        if content is not None:
            binary = isinstance(content, bytes)
            headers["content-type"] = "application/octet-stream" if binary else "application/json"
        try:
            response = self._http.request(
                method, path, params=httpx.QueryParams(given), content=content, headers=headers
            )
        except httpx.TransportError as error:
            raise UnavailableError(
                f"episode store at {_shown(self._http.base_url)}: {method} {path} got no answer "
                f"({type(error).__name__}: {error}); check the address or try again later"
            ) from error
        if response.is_success:
            return response
        raise _refusal(response)


def _shown(url: httpx.URL) -> httpx.URL:
    """An address without the name and password that it may hold, and without its query."""
    return url.copy_with(query=None, username=None, password=None)


def _refusal(response: httpx.Response) -> DexTouchError:
    try:
        where = f"{response.request.method} {_shown(response.request.url)}"
        return schemas.error_from_problem(
            schemas.Problem.model_validate_json(response.content), where
        )
    except ValidationError:
        # A proxy in between may send Retry-After, too.
        seconds = response.headers.get("retry-after", "")
        return UnavailableError(
            f"episode store: {response.request.method} {response.request.url.path} answered "
            f"{response.status_code} without a reason",
            **({"retry_after_s": int(seconds)} if seconds.isdecimal() else {}),
        )


def _part(text: str) -> str:
    return quote(text, safe="")
