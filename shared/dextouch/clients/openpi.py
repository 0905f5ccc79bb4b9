"""Policies that are served by openpi's WebSocket protocol."""

from collections import defaultdict, deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from threading import Lock
from typing import Any, ClassVar, Final
from weakref import WeakValueDictionary

import numpy as np
import structlog
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from dextouch.clients.rollouts import PolicyStart
from dextouch.errors import DexTouchError, InvalidInputError, ShapeError, UnavailableError
from dextouch.hands.actions import ACTION_DIM
from dextouch.schemas import Observation
from dextouch.streams import pack_openpi, unpack_openpi

logger = structlog.get_logger(__name__)

MAX_ANSWER_BYTES: Final = 2**26  # chosen: chunks of actions have kilobytes
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
        self._is_user = True

    @property
    def metadata(self) -> dict[str, Any]:
        """What the server said about itself when it was connected."""
        return self._server.metadata

    def reset(self, start: PolicyStart) -> None:
        """Remember the instruction, and tell a server that `resets`, which openpi's do not."""
        self._prompt = start.instruction
        if self.metadata.get("resets") is True:
            self._ask({"reset": True})

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
        actions = self._ask(request).get("actions")
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
        """Close the connection, unless other policies use it; the next `act` opens another."""
        if self._is_user:
            self._is_user = False
            self._server.leave()

    def _ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        if not self._is_user:
            self._is_user = True
            self._server.join()
        return self._server.ask(request)


class _Server:
    """A connection to a policy server; one that batches is shared by the threads of a process."""

    _shared: ClassVar[WeakValueDictionary[tuple[str, str | None, float], "_Server"]] = (
        WeakValueDictionary()
    )
    # For each address, since a server that is silent must not delay those of others.
    _sharing: ClassVar[defaultdict[tuple[str, str | None, float], Lock]] = defaultdict(Lock)

    def __init__(self, url: str, api_key: str | None, timeout_s: float) -> None:
        self._url, self._timeout_s = url, timeout_s
        self._headers = None if api_key is None else {"Authorization": f"Api-Key {api_key.strip()}"}
        self._open = ExitStack()
        self._connection: ClientConnection | None = None
        self._worker = ThreadPoolExecutor(1, "policy_server")
        self._waiting: deque[tuple[Mapping[str, Any], Future[dict[str, Any]]]] = deque()
        self._num_users, self._counting = 0, Lock()
        self.metadata: dict[str, Any] = {}
        self._connected()
        self._is_shared = self.max_batch > 1

    @property
    def max_batch(self) -> int:
        """Requests of one message, 1 where they are not joined."""
        given, resets = self.metadata.get("max_batch"), self.metadata.get("resets")
        return given if isinstance(given, int) and given > 1 and resets is not True else 1

    @classmethod
    def at(cls, url: str, api_key: str | None, timeout_s: float) -> "_Server":
        """A connection for one more user; the one that is there if its requests can be joined."""
        address = (url, api_key, timeout_s)
        with cls._sharing[address]:
            server = cls._shared.get(address)
            if server is None:
                server = cls(url, api_key, timeout_s)
                if server._is_shared:
                    cls._shared[address] = server
            server.join()
            return server

    def join(self) -> None:
        """Count one more user."""
        with self._counting:
            self._num_users += 1

    def leave(self) -> None:
        """Count one user less; the last one closes the connection, after what is under way."""
        with self._counting:
            self._num_users -= 1
            if self._num_users > 0:
                return
        if self._is_shared:
            self._worker.submit(self._disconnect).result()
        else:
            self._disconnect()

    def ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Answer to a request; those of other threads that wait meanwhile go together."""
        if not self._is_shared:
            return self._exchange(request)
        answer: Future[dict[str, Any]] = Future()
        self._waiting.append((request, answer))
        self._worker.submit(self._answer_waiting)
        return answer.result()

    def _answer_waiting(self) -> None:
        """Answer all requests that wait, at most `max_batch`; the worker does so once for each."""
        batch = [self._waiting.popleft() for _ in range(min(self.max_batch, len(self._waiting)))]
        try:
            if len(batch) > 1:
                answers = self._exchange_all([request for request, _ in batch])
                for (_, answer), given in zip(batch, answers, strict=True):
                    answer.set_result(given)
                return
        except UnavailableError as error:
            self._fail(batch, error)
            return
        except DexTouchError as error:
            # One of them may be what the server refuses, so each is asked by itself.
            logger.warning("policy_batch_failed", url=self._url, error=error.message)
        except BaseException as error:
            # Whatever happens, no thread waits for ever.
            self._fail(batch, error)
            raise
        for index, (request, answer) in enumerate(batch):
            try:
                answer.set_result(self._exchange(request))
            except UnavailableError as error:
                self._fail(batch[index:], error)
                return
            except DexTouchError as error:
                answer.set_exception(error)
            except BaseException as error:
                self._fail(batch[index:], error)
                raise

    def _fail(
        self,
        batch: Sequence[tuple[Mapping[str, Any], Future[dict[str, Any]]]],
        cause: BaseException,
    ) -> None:
        """End requests by an error of their own each, since each thread adds to its traceback."""
        message = f"policy server {self._url}: was interrupted ({type(cause).__name__}: {cause})"
        if isinstance(cause, UnavailableError):
            message = cause.message
        for _, answer in batch:
            failure = UnavailableError(message)
            failure.__cause__ = cause
            answer.set_exception(failure)

    def _exchange_all(self, requests: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
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
        with self._lost_on_errors():
            connection.send(pack_openpi(request))
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
            # A server that was started again may say something else.
            self.metadata = self._receive(self._connection)
        return self._connection

    def _receive(self, connection: ClientConnection) -> dict[str, Any]:
        with self._lost_on_errors():
            answer = connection.recv(self._timeout_s)
            if isinstance(answer, str):
                # openpi sends errors, tracebacks included, as text, and closes the connection.
                raise InvalidInputError(f"policy server {self._url}: reported {answer[-2000:]}")
            return unpack_openpi(answer, max_bytes=MAX_ANSWER_BYTES)

    @contextmanager
    def _lost_on_errors(self) -> Iterator[None]:
        """Disconnect on whatever ends an exchange early, an interrupt of this process included.

        An answer that comes late must not be taken for that to the next request.
        """
        try:
            yield
        except (OSError, WebSocketException) as error:
            self._disconnect()
            raise UnavailableError(
                f"policy server {self._url}: no answer within {self._timeout_s:g} s or connection "
                f"lost ({type(error).__name__}: {error})"
            ) from error
        except BaseException:
            self._disconnect()
            raise
