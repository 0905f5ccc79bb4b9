"""Policies that are served by openpi's WebSocket protocol."""

from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any, Final

import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from dextouch.clients.rollouts import PolicyStart
from dextouch.errors import InvalidInputError, ShapeError, UnavailableError
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
        self._url, self._images = url, dict(images)
        self._chunk_steps, self._timeout_s = chunk_steps, timeout_s
        self._prompt = ""
        self._headers = None if api_key is None else {"Authorization": f"Api-Key {api_key}"}
        self._open = ExitStack()
        self._connection: ClientConnection | None = None
        self.metadata: dict[str, Any] = {}
        self._connected()

    def reset(self, start: PolicyStart) -> None:
        """Remember the instruction, and tell a server that `resets`, which openpi's do not."""
        self._prompt = start.instruction
        if self.metadata.get("resets") is True:
            connection = self._connected()
            self._send(connection, {"reset": True})
            self._receive(connection)

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
        connection = self._connected()
        self._send(connection, request)
        actions = self._receive(connection).get("actions")
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

    def _send(self, connection: ClientConnection, request: Mapping[str, Any]) -> None:
        try:
            connection.send(pack_openpi(request))
        except (OSError, WebSocketException) as error:
            raise self._gone(error) from error

    def _receive(self, connection: ClientConnection) -> dict[str, Any]:
        try:
            answer = connection.recv(self._timeout_s)
        except (OSError, WebSocketException) as error:
            raise self._gone(error) from error
        if isinstance(answer, str):
            # openpi sends errors, tracebacks included, as text, and closes the connection.
            self.close()
            raise InvalidInputError(f"policy server {self._url}: reported {answer[-2000:]}")
        return unpack_openpi(answer, max_bytes=MAX_ANSWER_BYTES)

    def _gone(self, error: Exception) -> UnavailableError:
        # An answer that comes late must not be taken for that to the next request.
        self.close()
        return UnavailableError(
            f"policy server {self._url}: no answer within {self._timeout_s:g} s or connection lost "
            f"({type(error).__name__}: {error})"
        )
