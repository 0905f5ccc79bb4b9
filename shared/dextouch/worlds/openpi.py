"""Rollouts over a WebSocket in openpi's message format, for openpi's clients and for low latency.

docs/rollout_api.md has the messages; those that are refused are answered with text.
"""

from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Final

import numpy as np
from fastapi import APIRouter
from starlette.websockets import WebSocket, WebSocketDisconnect

from dextouch.errors import DexTouchError, InvalidInputError
from dextouch.hands.actions import ACTION_DIM
from dextouch.schemas import (
    EVERYTHING,
    ReturnSelector,
    WorldDescription,
    start_of_parts,
    validate_fields,
)
from dextouch.serving import (
    MAX_WEBSOCKET_BYTES,
    AccessControl,
    accept_messages_of,
    close_reason,
    decoded,
)
from dextouch.streams import pack_openpi, unpack, unpack_openpi
from dextouch.worlds.records import Answer
from dextouch.worlds.rollouts import RolloutService

SCOPE: Final = "rollout"
# What these rollouts are called where they are watched.
CLIENT: Final = "openpi"
_REFUSED: Final = 1008
_FORMS: Final = ("start", "resume", "actions", "end")
_KNOWN: Final = {*_FORMS, "chunk", "return"}


def largest_message(worlds: Sequence[WorldDescription], *, max_body_bytes: int) -> int:
    """Bytes of the largest message that a start in one of these worlds needs.

    A world that starts from an observation needs one step of its images, touch and poses; one that
    scales images takes them of any size, up to `max_body_bytes`.
    """
    needed = MAX_WEBSOCKET_BYTES
    for world in worlds:
        if "observation" in world.starts_from:
            area_px = world.image_height_px * world.image_width_px
            images = max_body_bytes if world.scales_images else 3 * area_px * len(world.cameras)
            touch = 2 * 4 * world.num_taxels
            needed = max(needed, images + touch + MAX_WEBSOCKET_BYTES)
    return min(needed, max(max_body_bytes, MAX_WEBSOCKET_BYTES))


def openpi_router(service: RolloutService) -> APIRouter:
    """Router of the WebSocket `/v1/openpi`."""
    router = APIRouter(prefix="/v1")

    @router.websocket("/openpi")
    async def openpi(socket: WebSocket) -> None:
        access: AccessControl = socket.app.state.access
        authorization = socket.headers.get("authorization")
        try:
            owner = access.check(authorization, SCOPE)
        except DexTouchError as error:
            await socket.close(_REFUSED, close_reason(error.message))
            return
        await socket.accept()
        described = service.worlds()
        worlds = [world.model_dump(mode="json") for world in described]
        max_body_bytes = socket.app.state.settings.max_body_bytes
        max_bytes = largest_message(described, max_body_bytes=max_body_bytes)
        accept_messages_of(socket, max_bytes)
        session = _Session(service, owner, max_bytes)
        with suppress(WebSocketDisconnect):
            await socket.send_bytes(pack_openpi({"worlds": worlds, "action_dim": ACTION_DIM}))
            while (message := await socket.receive())["type"] == "websocket.receive":
                try:
                    # It may have been removed since.
                    access.check(authorization, SCOPE)
                    answer = await session.answer(message.get("bytes"))
                except DexTouchError as error:
                    await socket.send_text(error.message)
                else:
                    await socket.send({"type": "websocket.send", "bytes": answer})

    return router


class _Session:
    def __init__(self, service: RolloutService, owner: str, max_bytes: int) -> None:
        self._service = service
        self._owner = owner
        self._unpack = partial(unpack_openpi, max_bytes=max_bytes)
        self._selector = EVERYTHING
        self._rollout_id: str | None = None
        self._next_chunk = 0

    async def answer(self, data: bytes | None) -> bytes:
        """Carry out one message; raises DexTouchError without a change of the rollout."""
        if data is None:
            raise InvalidInputError("message: got text, expected msgpack in a binary message")
        message = await decoded(self._unpack, data)
        given, known = message.keys() & _FORMS, _KNOWN
        if "start" in given:
            known = known | {"observation", *_arrays_of(message)}
        if len(given) != 1 or message.keys() - known:
            raise InvalidInputError(
                f"message: got the keys {', '.join(sorted(message)) or 'none'}, expected one of "
                f"{', '.join(_FORMS)}, and optionally chunk and return"
            )
        before = self._selector
        if "return" in message:
            self._selector = validate_fields(ReturnSelector, message["return"], where="return")
        try:
            return await getattr(self, f"_{given.pop()}")(message)
        except DexTouchError:
            self._selector = before
            raise

    async def _start(self, message: dict[str, Any]) -> bytes:
        arrays = _arrays_of(message)
        fields: dict[str, Any] = {
            name: message[name] for name in ("start", "observation") if name in message
        }
        if arrays and "observation" not in fields:
            raise InvalidInputError(
                f"start: got arrays ({', '.join(sorted(arrays))}) without 'observation', expected "
                "first_step and reached_is_measured, as an answer has them beside its arrays"
            )
        request, begin = start_of_parts(fields, arrays)
        answer = await self._service.start(
            request.world, begin, self._selector, owner=self._owner, client=CLIENT
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
        answer = await self._service.step(self._current(), chunk, actions, self._selector)
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


def _arrays_of(message: dict[str, Any]) -> dict[str, np.ndarray]:
    """Arrays beside a start, of this machine's byte order."""
    return {
        name: np.asarray(value, value.dtype.newbyteorder("="))
        for name, value in message.items()
        if isinstance(value, np.ndarray) and name not in _KNOWN
    }
