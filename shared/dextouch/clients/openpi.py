"""Policies that are served by openpi's WebSocket protocol."""

from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from threading import Lock
from typing import Any, ClassVar, Final
from weakref import WeakValueDictionary

import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from dextouch.clients.rollouts import PolicyStart
from dextouch.errors import DexTouchError, InvalidInputError, ShapeError, UnavailableError
from dextouch.hands.actions import ACTION_DIM
from dextouch.schemas import Observation
from dextouch.streams import pack_openpi, unpack_openpi

MAX_ANSWER_BYTES: Final = 2**26
DEFAULT_IMAGES: Final = {"observation/image": "camera_head"}


class OpenPiPolicy:
    """Sends observations to a server of openpi's protocol and returns its actions.

    Each request holds the newest step: images (uint8 [h, w, 3]) under the names in `images`,
    `observation/state` (float64 [67], the reached poses and joint angles, relative to the rollout's
    step 0), `observation/tactile` (float32 [2, taxels] in kPa), and the instruction as `prompt`.
    The server answers with `actions`, rows of 67 numbers that are commands relative to step 0.

    A server whose metadata has `max_batch` of at least 2 gets the requests of several threads of
    this process together, as `{"batch": [request, …]}`, and answers `{"batch": [answer, …]}`; one
    that `resets` keeps a state for each connection, so its requests are never joined.

    Args:
        url: of the server, such as `ws://127.0.0.1:8000`.
        api_key: sent as `Authorization: Api-Key KEY`.
        images: camera by the name that the server expects.
        chunk_steps: rows of each answer that are carried out.
        timeout_s: for one answer.

    Raises:
        UnavailableError: the server does not answer.
    """

    uses_images = "last"

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        images: Mapping[str, str] = DEFAULT_IMAGES,
        chunk_steps: int = 16,
        timeout_s: float = 60.0,
    ) -> None:
        if chunk_steps < 1:
            raise InvalidInputError(f"chunk_steps: got {chunk_steps}, expected at least 1")
        self._url, self._images, self._chunk_steps = url, dict(images), chunk_steps
        self._prompt = ""
        self._server = _Server.at(url, api_key, timeout_s)

    @property
    def metadata(self) -> dict[str, Any]:
        """What the server said about itself when it was connected."""
        return self._server.metadata

    def reset(self, start: PolicyStart) -> None:
        """Remember the instruction, and tell a server that `resets`, which openpi's do not."""
        self._prompt = start.instruction
        if self.metadata.get("resets") is True:
            self._server.ask({"reset": True})

    def act(self, observation: Observation) -> np.ndarray:
        """Actions [K, 67] of the server for the newest step.

        Raises:
            UnavailableError: the server closed the connection or did not answer in time.
            InvalidInputError: the server reported an error, or an answer without actions.
            ShapeError: actions of another width.
        """
        request: dict[str, Any] = {
            name: observation.images[camera][-1] for name, camera in self._images.items()
        }
        request["observation/state"] = observation.action_reached[-1]
        request["observation/tactile"] = observation.tactile_kpa[-1]
        request["prompt"] = self._prompt
        actions = self._server.ask(request).get("actions")
        if not isinstance(actions, np.ndarray):
            raise InvalidInputError(
                f"policy server {self._url}: its answer has no array `actions`; got "
                f"{type(actions).__name__}"
            )
        if actions.ndim != 2 or actions.shape[1] != ACTION_DIM:
            raise ShapeError(
                f"policy server {self._url}: got actions of shape {list(actions.shape)}, expected "
                f"[K, {ACTION_DIM}]"
            )
        return actions[: self._chunk_steps]

    def close(self) -> None:
        """Close the connection; the next `act` opens another."""
        self._server.close()


class _Server:
    """A connection to a policy server; one that batches is shared by the threads of a process."""

    _shared: ClassVar[WeakValueDictionary[tuple[str, str | None, float], "_Server"]] = (
        WeakValueDictionary()
    )
    _sharing: ClassVar[Lock] = Lock()

    def __init__(self, url: str, api_key: str | None, timeout_s: float) -> None:
        self._url, self._timeout_s = url, timeout_s
        self._headers = None if api_key is None else {"Authorization": f"Api-Key {api_key}"}
        self._open = ExitStack()
        self._connection: ClientConnection | None = None
        self._worker = ThreadPoolExecutor(1, "policy_server")
        self._waiting: deque[tuple[Mapping[str, Any], Future[dict[str, Any]]]] = deque()
        self.metadata: dict[str, Any] = {}
        self._connected()
        given, resets = self.metadata.get("max_batch"), self.metadata.get("resets")
        # Requests of one message, 1 where they are not joined.
        self.max_batch = 1
        if isinstance(given, int) and given > 1 and resets is not True:
            self.max_batch = given

    @classmethod
    def at(cls, url: str, api_key: str | None, timeout_s: float) -> "_Server":
        """A connection to a server; the one that is there if its requests can be joined."""
        with cls._sharing:
            address = (url, api_key, timeout_s)
            server = cls._shared.get(address)
            if server is None:
                server = cls(url, api_key, timeout_s)
                if server.max_batch > 1:
                    cls._shared[address] = server
            return server

    def ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Answer to a request; those of other threads that wait meanwhile go together."""
        if self.max_batch == 1:
            return self._exchange(request)
        answer: Future[dict[str, Any]] = Future()
        self._waiting.append((request, answer))
        self._worker.submit(self._answer_waiting)
        return answer.result()

    def close(self) -> None:
        """Close the connection, after the request that is under way."""
        if self.max_batch == 1:
            self._disconnect()
        else:
            self._worker.submit(self._disconnect).result()

    def _answer_waiting(self) -> None:
        """Answer all requests that wait, at most `max_batch`; the worker does so once for each."""
        batch = [self._waiting.popleft() for _ in range(min(self.max_batch, len(self._waiting)))]
        failure: DexTouchError = UnavailableError(f"policy server {self._url}: was interrupted")
        answers: list[dict[str, Any]] = []
        try:
            if batch:
                answers = self._exchange_all([request for request, _ in batch])
        except DexTouchError as error:
            failure = error
        finally:
            # Whatever happens, no thread waits for ever.
            for index, (_, answer) in enumerate(batch):
                if answers:
                    answer.set_result(answers[index])
                else:
                    answer.set_exception(failure)

    def _exchange_all(self, requests: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        if len(requests) == 1:
            return [self._exchange(requests[0])]
        given = self._exchange({"batch": list(requests)}).get("batch")
        answers: list[Any] = given if isinstance(given, list) else []
        if len(answers) != len(requests) or not all(isinstance(one, dict) for one in answers):
            raise InvalidInputError(
                f"policy server {self._url}: got {len(answers)} answers to a batch, expected "
                f"{len(requests)} maps under 'batch'; its metadata must have no max_batch if it "
                "does not take batches"
            )
        return answers

    def _exchange(self, request: Mapping[str, Any]) -> dict[str, Any]:
        connection = self._connected()
        try:
            connection.send(pack_openpi(request))
        except (OSError, WebSocketException) as error:
            raise self._gone(error) from error
        return self._receive(connection)

    def _disconnect(self) -> None:
        self._connection = None
        self._open.close()

    def _connected(self) -> ClientConnection:
        """The connection; a new one where the last was lost or did not answer in time."""
        if self._connection is None:
            try:
                self._connection = self._open.enter_context(
                    connect(
                        self._url,
                        compression=None,
                        max_size=MAX_ANSWER_BYTES,
                        additional_headers=self._headers,
                        open_timeout=self._timeout_s,
                        # A server may compute, or compile, for longer than a ping would wait.
                        ping_interval=None,
                        proxy=None,
                    )
                )
            except (OSError, WebSocketException) as error:
                raise UnavailableError(
                    f"policy server {self._url}: does not answer ({error})"
                ) from error
            self.metadata = self._receive(self._connection)
        return self._connection

    def _receive(self, connection: ClientConnection) -> dict[str, Any]:
        try:
            answer = connection.recv(self._timeout_s)
        except (OSError, WebSocketException) as error:
            raise self._gone(error) from error
        if isinstance(answer, str):
            # openpi sends errors, tracebacks included, as text, and closes the connection.
            self._disconnect()
            raise InvalidInputError(f"policy server {self._url}: reported {answer[-2000:]}")
        return unpack_openpi(answer, max_bytes=MAX_ANSWER_BYTES)

    def _gone(self, error: Exception) -> UnavailableError:
        # An answer that comes late must not be taken for that to the next request.
        self._disconnect()
        return UnavailableError(
            f"policy server {self._url}: no answer within {self._timeout_s:g} s or connection lost "
            f"({type(error).__name__}: {error})"
        )
