"""Rollouts over a WebSocket in openpi's message format, for openpi's clients and for low latency.

The server first sends what it serves. Then every message of the client has one of these forms, and
is answered with a map, or with text that says why it was refused (docs/rollout_api.md):

- {"start": {"world", "task", "seed", "instruction"}}: begin a rollout
- {"resume": ID}: continue a rollout that was begun here or over HTTP
- {"actions": [K, 67]}: advance; with "chunk": N as the route of chunks, so that it may be repeated
- {"end": true}: end the rollout

"return": {"steps", "cameras", "tactile"} beside them selects what later answers hold.
"""

from contextlib import suppress
from typing import Any, Final

import numpy as np
from fastapi import APIRouter
from starlette.websockets import WebSocket, WebSocketDisconnect

from dextouch.errors import DexTouchError, InvalidInputError
from dextouch.hands.actions import ACTION_DIM
from dextouch.schemas import EVERYTHING, ReturnSelector, StartRequest, start_from, validate_fields
from dextouch.serving import MAX_WEBSOCKET_BYTES
from dextouch.streams import pack_openpi, unpack, unpack_openpi
from dextouch.worlds.records import Answer
from dextouch.worlds.rollouts import RolloutService

SCOPE: Final = "rollout"
# What these rollouts are called where they are watched.
CLIENT: Final = "openpi"
_REFUSED: Final = 1008
_FORMS: Final = ("start", "resume", "actions", "end")
_KNOWN: Final = {*_FORMS, "chunk", "return"}


def openpi_router(service: RolloutService) -> APIRouter:
    """Router of the WebSocket `/v1/openpi`."""
    router = APIRouter(prefix="/v1")

    @router.websocket("/openpi")
    async def openpi(socket: WebSocket) -> None:
        try:
            authorization = socket.headers.get("authorization")
            owner = socket.app.state.access.check(authorization, SCOPE)
        except DexTouchError as error:
            await socket.close(_REFUSED, error.message[:120])
            return
        await socket.accept()
        worlds = [world.model_dump(mode="json") for world in service.worlds()]
        session = _Session(service, owner)
        with suppress(WebSocketDisconnect):
            await socket.send_bytes(pack_openpi({"worlds": worlds, "action_dim": ACTION_DIM}))
            while (message := await socket.receive())["type"] == "websocket.receive":
                try:
                    answer = await session.answer(message.get("bytes"))
                except DexTouchError as error:
                    await socket.send_text(error.message)
                else:
                    await socket.send_bytes(answer)

    return router


class _Session:
    def __init__(self, service: RolloutService, owner: str) -> None:
        self._service = service
        self._owner = owner
        self._selector = EVERYTHING
        self._rollout_id: str | None = None
        self._next_chunk = 0

    async def answer(self, data: bytes | None) -> bytes:
        """Carry out one message; raises DexTouchError without a change of the rollout."""
        if data is None:
            raise InvalidInputError("message: got text, expected msgpack in a binary message")
        message = unpack_openpi(data, max_bytes=MAX_WEBSOCKET_BYTES)
        given = [name for name in _FORMS if name in message]
        if len(given) != 1 or set(message) - _KNOWN:
            raise InvalidInputError(
                f"message: got the keys {', '.join(sorted(message)) or 'none'}, expected one of "
                f"{', '.join(_FORMS)}, and optionally chunk and return"
            )
        before = self._selector
        if "return" in message:
            self._selector = validate_fields(ReturnSelector, message["return"], where="return")
        try:
            return await getattr(self, f"_{given[0]}")(message)
        except DexTouchError:
            self._selector = before
            raise

    async def _start(self, message: dict[str, Any]) -> bytes:
        request = validate_fields(StartRequest, message["start"], where="start")
        answer = await self._service.start(
            request.world, start_from(request), self._selector, owner=self._owner, client=CLIENT
        )
        return self._repacked(answer)

    async def _resume(self, message: dict[str, Any]) -> bytes:
        info = await self._service.get(str(message["resume"]))
        self._rollout_id, self._next_chunk = info.id, info.next_chunk
        return pack_openpi({"rollout": info.model_dump(mode="json")})

    async def _actions(self, message: dict[str, Any]) -> bytes:
        actions, chunk = message["actions"], message.get("chunk", self._next_chunk)
        if not isinstance(actions, np.ndarray):
            raise InvalidInputError(
                f"actions: got {type(actions).__name__}, expected an array [K, {ACTION_DIM}]"
            )
        if not isinstance(chunk, int) or isinstance(chunk, bool):
            raise InvalidInputError(f"chunk: got {chunk!r}, expected a whole number")
        answer = await self._service.step(
            self._current(), chunk, np.asarray(actions, np.float64), self._selector
        )
        return self._repacked(answer)

    async def _end(self, message: dict[str, Any]) -> bytes:
        del message
        rollout_id = self._current()
        await self._service.delete(rollout_id)
        self._rollout_id = None
        return pack_openpi({"ended": rollout_id})

    def _current(self) -> str:
        if self._rollout_id is None:
            raise InvalidInputError("message: there is no rollout; send start or resume first")
        return self._rollout_id

    def _repacked(self, answer: Answer) -> bytes:
        """A response of the rollout service in openpi's format; images and arrays by name."""
        size = len(answer.payload)
        fields, arrays = answer.parts or unpack(answer.payload, max_bytes=size)
        info = fields["rollout"]
        self._rollout_id, self._next_chunk = info["id"], info["next_chunk"]
        return pack_openpi({**fields, **arrays, "replayed": answer.replayed})
