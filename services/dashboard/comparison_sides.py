"""The two sides of a comparison: a rollout in a world, or what an episode recorded."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Final
from urllib.parse import quote, urlencode

import numpy as np
from jaxtyping import UInt8

from dextouch import schemas
from dextouch.episodes import Window, decode_window
from dextouch.errors import DexTouchError, InvalidInputError
from dextouch.serving import MSGPACK, OCTETS
from dextouch.streams import HEAD_CAMERA
from dextouch.tactile import DEXTOUCH_V1
from services.dashboard.rollout_feeds import MAX_RESPONSE_BYTES
from services.dashboard.upstream import Upstream

WORLD_TIMEOUT_S: Final = 120.0
# Observation of step 0, with the anchor and the matrix of the head camera.
FirstStep = tuple[schemas.Observation, schemas.RolloutOrigin]


@dataclass
class WorldSide:
    """A rollout in the world of a service."""

    upstream: Upstream
    world: schemas.WorldDescription
    rollout_id: str = ""

    @property
    def name(self) -> str:
        """Name of the world."""
        return self.world.name

    async def start(self, request: schemas.StartRequest, first: FirstStep | None) -> FirstStep:
        """The first observation, with anchor and camera matrix; `first` is the other side's."""
        request = request.model_copy(update={"world": self.world.name})
        seen, origin = (None, None) if first is None else first
        begin = schemas.start_from(request, observation=seen, origin=origin)
        body = schemas.encode_start(request, begin)
        answer = await self._post("/v1/rollouts", MSGPACK, body)
        self.rollout_id = answer.rollout.id
        if answer.origin is None:
            raise InvalidInputError(f"world {self.name}: its first observation has no anchor")
        return answer.observation, answer.origin

    async def step(
        self, number: int, rows: np.ndarray
    ) -> tuple[schemas.Observation, Mapping[str, float]]:
        """The steps after chunk `number`, [steps, 67], and what the world reports about them."""
        path = f"/v1/rollouts/{self.rollout_id}/chunks/{number}"
        answer = await self._post(path, f"{OCTETS}; dtype=float64", rows.astype("<f8").tobytes())
        return answer.observation, answer.info

    async def end(self) -> None:
        """End the rollout."""
        if self.rollout_id:
            with suppress(DexTouchError):
                await self.upstream.send("DELETE", f"/v1/rollouts/{self.rollout_id}")

    async def _post(self, path: str, kind: str, body: bytes) -> schemas.RolloutAnswer:
        headers = {"content-type": kind, "accept": MSGPACK, "dextouch-client": "dashboard"}
        path = f"{path}?{urlencode({'cameras': HEAD_CAMERA})}"
        answer = await self.upstream.send(
            "POST", path, body, headers=headers, timeout_s=WORLD_TIMEOUT_S
        )
        return schemas.decode_answer(answer.content, max_bytes=MAX_RESPONSE_BYTES)


@dataclass
class RecordedSide:
    """The steps that an episode of the store recorded."""

    store: Upstream
    attributes: schemas.EpisodeAttributes
    num_steps: int
    name: str = "recording"
    next_step: int = 0

    async def start(self, request: schemas.StartRequest, first: FirstStep | None) -> FirstStep:
        """See `WorldSide`."""
        del request, first
        seen, window = await self._read(1)
        # Without a matrix this refuses, and says what to do.
        return seen, schemas.RolloutOrigin(window.anchor, self.attributes.K_head_matrix())

    async def step(
        self, number: int, rows: np.ndarray
    ) -> tuple[schemas.Observation, Mapping[str, float]]:
        """See `WorldSide`."""
        del number
        seen, _ = await self._read(len(rows))
        return seen, {}

    async def end(self) -> None:
        """See `WorldSide`."""

    async def _read(self, num_steps: int) -> tuple[schemas.Observation, Window]:
        first_step = self.next_step
        query = {"start": first_step, "num_steps": num_steps, "cameras": HEAD_CAMERA}
        path = f"/v1/episodes/{quote(self.attributes.episode_id)}/windows?{urlencode(query)}"
        answer = await self.store.send("GET", path, timeout_s=WORLD_TIMEOUT_S)
        window = decode_window(answer.content, max_bytes=MAX_RESPONSE_BYTES)
        if window.tactile_layout != DEXTOUCH_V1:
            raise InvalidInputError(
                f"episode {self.attributes.episode_id!r}: got the tactile layout "
                f"{window.tactile_layout.name!r}, expected dextouch_v1; only its taxels can be "
                "compared"
            )
        self.next_step += num_steps
        seen = schemas.Observation(
            first_step=first_step,
            images=window.images,
            tactile_kpa=window.tactile_kpa,
            action_reached=window.actions,
            reached_is_measured=True,
            # Of the whole take, which says nothing about a part of it.
            success=self.attributes.success if self.next_step == self.num_steps else None,
        )
        return seen, window


def fitted(
    images: UInt8[np.ndarray, "n h w 3"], size_px: tuple[int, int]
) -> UInt8[np.ndarray, "n height width 3"]:
    """The middle of images at another size (height, width), by their nearest pixels.

    Worlds that take images of any size scale the same middle part.
    """
    if images.shape[1:3] == size_px:
        return images
    scale = min(have / want for have, want in zip(images.shape[1:3], size_px, strict=True))
    rows, columns = (
        ((np.arange(want) + 0.5 - want / 2) * scale + have / 2).astype(np.intp)
        for have, want in zip(images.shape[1:3], size_px, strict=True)
    )
    return images[:, rows[:, None], columns]


Side = WorldSide | RecordedSide
