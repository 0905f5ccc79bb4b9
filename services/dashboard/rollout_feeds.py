"""Topics of the rollouts screen: open rollouts of all worlds, and the newest steps of one."""

import asyncio
import re
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
from pydantic import Field
from pydantic_core import to_json

from dextouch import schemas
from dextouch.errors import DexTouchError, NotFoundError
from dextouch.frozen_model import FrozenModel, is_none
from dextouch.streams import unpack
from dextouch.tactile import LayoutDescription
from services.dashboard.feeds import Feeds, Message, Topic, topic_message
from services.dashboard.settings import DashboardSettings

WORLD_SERVICES: Final = ("twin", "world_model")
MAX_LISTED: Final = 100
NUM_OVER: Final = 10
MAX_RESPONSE_BYTES: Final = 2**28
# Of one message; of more images, only every second, third, … step is sent.
MAX_IMAGE_BYTES: Final = 4 * 2**20
MAX_TOPICS: Final = 64
STEPS_MESSAGE: Final = 2
_TOPIC: Final = re.compile(rf"rollout/({'|'.join(WORLD_SERVICES)})/([0-9a-f]{{32}})")


class WorldView(FrozenModel):
    """A world of a service, and what its rollouts can say about themselves."""

    service: str
    name: str
    kind: schemas.WorldKind
    tasks: tuple[str, ...]
    model_rate_hz: float
    predicts_touch: bool
    tactile_layout: LayoutDescription | None = Field(default=None, exclude_if=is_none)


class ListedRollout(schemas.WatchedRollout):
    """An open rollout and the service where it runs."""

    service: str
    kind: schemas.WorldKind | None = None
    model_rate_hz: float | None = None


class RolloutsView(FrozenModel):
    """Open rollouts of all services; `problems` are the reasons of services that list none.

    `over` are the ten that ended last, by when their last chunk was. `has_episodes` if a store is
    configured, whose episodes can be replayed.
    """

    worlds: tuple[WorldView, ...] = ()
    rollouts: tuple[ListedRollout, ...] = ()
    over: tuple[ListedRollout, ...] = ()
    num_open: int = 0
    has_episodes: bool = False
    problems: tuple[str, ...] = ()


class RolloutFeeds:
    """Reads open rollouts from the services of worlds, while somebody looks."""

    def __init__(self, feeds: Feeds, settings: DashboardSettings) -> None:
        self._feeds = feeds
        self._period_s = settings.station_period_s
        self._listed = Topic.of_json("rollouts", max(0.5, settings.station_period_s), self.listed)
        self._watched: OrderedDict[str, Topic] = OrderedDict()

    def topic(self, name: str) -> Topic | None:
        """The topic `rollouts`, or `rollout/SERVICE/WATCH_ID`; None for other names."""
        if name == self._listed.name:
            return self._listed
        place = _TOPIC.fullmatch(name)
        if place is None:
            return None
        if name not in self._watched:
            watched = _Watched(self._feeds, name, service=place[1], watch_id=place[2])
            self._watched[name] = Topic(name, self._period_s, watched.fetch)
            if len(self._watched) > MAX_TOPICS:
                self._watched.popitem(last=False)
        self._watched.move_to_end(name)
        return self._watched[name]

    async def listed(self) -> RolloutsView:
        """Open rollouts of all worlds, the newest first."""
        names = [name for name in WORLD_SERVICES if self._feeds.has(name)]
        if not names:
            return RolloutsView(
                problems=(
                    "This dashboard was started without DEXTOUCH_DASHBOARD_TWIN_URL and "
                    "DEXTOUCH_DASHBOARD_WORLD_MODEL_URL: no rollouts are shown.",
                )
            )
        found = await asyncio.gather(*(self._of_service(name) for name in names))
        rollouts = sorted((one for view in found for one in view.rollouts), key=lambda o: o.age_s)
        over = sorted((one for view in found for one in view.over), key=lambda o: o.idle_s)
        return RolloutsView(
            worlds=tuple(world for view in found for world in view.worlds),
            rollouts=tuple(rollouts),
            over=tuple(over[:NUM_OVER]),
            num_open=sum(view.num_open for view in found),
            has_episodes=self._feeds.has("episode_store"),
            problems=tuple(text for view in found for text in view.problems),
        )

    async def _of_service(self, service: str) -> RolloutsView:
        upstream = self._feeds.upstream(service)
        try:
            described, listed = await asyncio.gather(
                upstream.read(schemas.WorldList, "/v1/worlds"),
                upstream.read(schemas.WatchedRollouts, f"/v1/watch?limit={MAX_LISTED}"),
            )
        except DexTouchError as error:
            # Failures of the connection name the service themselves.
            reason = error.message.removeprefix(f"{service}: ")
            if error.details.get("no_answer"):
                reason = f"no answer from {upstream.address}; is the service running?"
            return RolloutsView(problems=(f"{service}: {reason}",))
        worlds = {world.name: world for world in described.worlds}

        def shown_of(rollouts: Iterable[schemas.WatchedRollout]) -> tuple[ListedRollout, ...]:
            return tuple(
                ListedRollout(
                    service=service,
                    kind=worlds[one.world].kind if one.world in worlds else None,
                    model_rate_hz=worlds[one.world].model_rate_hz if one.world in worlds else None,
                    **dict(one),
                )
                for one in rollouts
            )

        shown = ("name", "kind", "tasks", "model_rate_hz", "predicts_touch", "tactile_layout")
        return RolloutsView(
            worlds=tuple(
                WorldView(service=service, **{name: getattr(world, name) for name in shown})
                for world in described.worlds
            ),
            rollouts=shown_of(listed.rollouts),
            over=shown_of(listed.over),
            num_open=listed.num_open,
        )


class _Watched:
    """The newest steps of one rollout, fetched again only after they changed."""

    def __init__(self, feeds: Feeds, topic: str, *, service: str, watch_id: str) -> None:
        self._feeds, self._topic, self._service = feeds, topic, service
        self._path = f"/v1/watch/{watch_id}"
        self._tag = ""
        self._messages: list[Message] = []

    async def fetch(self) -> list[Message]:
        """The message with the newest steps; one with the reason where there are none."""
        try:
            upstream = self._feeds.upstream(self._service)
            answer = await upstream.send("GET", self._path, headers={"if-none-match": self._tag})
        except NotFoundError:
            return [topic_message(self._topic, {"gone": True, "note": "It was ended, or expired."})]
        except DexTouchError as error:
            return [topic_message(self._topic, {"gone": False, "note": error.message})]
        if answer.is_success:
            content = answer.content
            self._messages = [await asyncio.to_thread(steps_message, self._topic, content)]
            self._tag = answer.headers.get("etag", "")
        return self._messages


def steps_message(topic: str, response: bytes) -> bytes:
    """Encode the steps of a response for the page.

    uint8 kind, three bytes of padding, uint32 size of the header, the header as JSON, then touch,
    float32 [steps, 2, num_taxels] in kPa, and per camera uint8 [steps, height, width, 3], RGB;
    little endian, the header padded to a multiple of four bytes.

    Raises:
        InvalidInputError: not a response of a rollout.
    """
    fields, arrays = unpack(response, max_bytes=MAX_RESPONSE_BYTES)
    arrays = schemas.decode_images(arrays, max_bytes=MAX_RESPONSE_BYTES, where=topic)
    images = {
        name.removeprefix(schemas.IMAGE_PREFIX): array
        for name, array in arrays.items()
        if name.startswith(schemas.IMAGE_PREFIX)
    }
    num_steps = len(arrays["action_reached"])
    stride = -(-sum(array.nbytes for array in images.values()) // MAX_IMAGE_BYTES) or 1
    # The last step is always among them.
    kept = np.arange(num_steps - 1, -1, -stride)[::-1]
    touch = arrays.get("tactile_kpa")
    header = {
        "topic": topic,
        **fields,
        "num_steps": num_steps,
        "steps": (fields["observation"]["first_step"] + kept).tolist(),
        "has_touch": touch is not None,
        "num_taxels": 0 if touch is None else touch.shape[-1],
        "cameras": [
            {"name": name, "height": array.shape[1], "width": array.shape[2]}
            for name, array in images.items()
        ],
    }
    parts = [] if touch is None else [np.ascontiguousarray(touch[kept], "<f4").tobytes()]
    parts += [array[kept].tobytes() for array in images.values()]
    return packed_message(STEPS_MESSAGE, header, parts)


def packed_message(kind: int, header: Mapping[str, Any], parts: list[bytes]) -> bytes:
    """A binary message of the page: kind, header as JSON, and arrays one behind the other."""
    text = to_json(header, inf_nan_mode="null")
    text += b" " * (-len(text) % 4)
    return b"".join([bytes([kind, 0, 0, 0]), len(text).to_bytes(4, "little"), text, *parts])
