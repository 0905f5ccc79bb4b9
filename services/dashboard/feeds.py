"""Data feeds of the page, polled from the other services and cached for all viewers."""

import asyncio
from collections.abc import Mapping
from typing import Any

import structlog

from dextouch.errors import DexTouchError, NotFoundError
from dextouch.streams import unpack
from dextouch.tactile.layout import SIDES
from services.dashboard import station_api, store_api
from services.dashboard.settings import DashboardSettings
from services.dashboard.topics import Message, Topic, topic_message
from services.dashboard.upstream import Upstream
from services.dashboard.views import (
    RefusedView,
    ServiceView,
    StationView,
    TakesView,
    taxel_message,
    unreachable_station,
)

logger = structlog.get_logger(__name__)

MAX_TAXEL_BYTES = 64 * 1024
NUM_TAKES = 6


class Feeds:
    """Reads everything that the page shows from the configured services."""

    def __init__(self, upstreams: Mapping[str, Upstream], settings: DashboardSettings) -> None:
        self._upstreams = upstreams
        self._clocks: dict[str, str] = {}
        topics = [
            Topic("station", settings.station_period_s, self._station_messages),
            Topic("taxels", settings.taxel_period_s, self._taxel_messages),
            Topic("cameras", settings.station_period_s, self._camera_messages),
            Topic("services", settings.list_period_s, self._service_messages),
            Topic("takes", settings.list_period_s, self._take_messages),
        ]
        self.topics = {topic.name: topic for topic in topics}

    def upstream(self, name: str) -> Upstream:
        """Client of a service by name.

        Raises:
            NotFoundError: this dashboard was started without its URL.
        """
        if name not in self._upstreams:
            raise NotFoundError(
                f"no {name} service: this dashboard was started without "
                f"DEXTOUCH_DASHBOARD_{name.upper()}_URL"
            )
        return self._upstreams[name]

    async def station(self) -> StationView:
        """Streams and recorder of the station, or why it is unreachable."""
        try:
            acquisition = self.upstream("acquisition")
            health, recorder = await asyncio.gather(
                acquisition.json("GET", station_api.HEALTH_PATH),
                acquisition.json("GET", station_api.RECORDER_PATH),
            )
            return station_api.station_view(health, recorder)
        except DexTouchError as error:
            return unreachable_station(error.message)

    async def services(self) -> list[ServiceView]:
        """Readiness of each service."""
        names = list(self._upstreams)
        answers = await asyncio.gather(*(self._upstreams[name].ready() for name in names))
        return [
            ServiceView(name=name, level="OK" if ready else "ERROR", message=reason)
            for name, (ready, reason) in zip(names, answers, strict=True)
        ]

    async def takes(self) -> TakesView:
        """The newest recordings and episodes, and takes that the store refused."""
        stored, refused = await asyncio.gather(self._stored(), self._refused())
        return stored.model_copy(update={"refused": refused})

    async def _refused(self) -> tuple[RefusedView, ...]:
        try:
            answer = await self.upstream("acquisition").json("GET", station_api.REFUSED_PATH)
            return station_api.refused_views(answer)
        except DexTouchError:
            return ()  # reported by the station topic

    async def _stored(self) -> TakesView:
        """Stored takes, newest first, or why there are none."""
        if "episode_store" not in self._upstreams:
            return TakesView(
                note="This dashboard was started without DEXTOUCH_DASHBOARD_EPISODE_STORE_URL: "
                "what is stored is not shown."
            )
        store = self._upstreams["episode_store"]
        try:
            recordings = await store_api.newest_recordings(store, NUM_TAKES)
            episodes = await store_api.newest_episodes(store, NUM_TAKES)
            known = self._clocks
            # Episodes are immutable: each is queried once.
            self._clocks = {
                item.episode_id: known[item.episode_id]
                if item.episode_id in known
                else await store_api.clock_words(store, item.episode_id)
                for item in episodes
            }
        except DexTouchError as error:
            logger.warning("takes_not_listed", error=error.message)
            return TakesView(note=f"The store does not list its takes: {error.message}")
        takes = (
            *(store_api.episode_view(item, self._clocks) for item in episodes),
            *(store_api.recording_view(item) for item in recordings),
        )
        return TakesView(takes=takes, note="" if takes else "Nothing stored yet.")

    async def operate(self, action: str, body: Mapping[str, Any]) -> dict[str, object]:
        """Perform a recorder action and return the recorder's new state."""
        path = station_api.action_path(action)
        answer = await self.upstream("acquisition").json("POST", path, body=body)
        return station_api.recorder_view(answer).model_dump()

    async def retry(self, recording_id: str) -> None:
        """Make the station upload a refused take again."""
        path = station_api.retry_path(recording_id)
        await self.upstream("acquisition").json("POST", path)

    async def camera_image(self, name: str) -> tuple[bytes, str]:
        """The newest image of a camera and its media type."""
        path = station_api.camera_path(name)
        content, headers = await self.upstream("acquisition").content(path)
        return content, headers.get("content-type", "image/jpeg")

    async def _station_messages(self) -> list[Message]:
        return [topic_message("station", (await self.station()).model_dump())]

    async def _service_messages(self) -> list[Message]:
        return [topic_message("services", [view.model_dump() for view in await self.services()])]

    async def _take_messages(self) -> list[Message]:
        return [topic_message("takes", (await self.takes()).model_dump())]

    async def _camera_messages(self) -> list[Message]:
        try:
            answer = await self.upstream("acquisition").json("GET", station_api.CAMERAS_PATH)
            views = [view.model_dump() for view in station_api.camera_views(answer)]
        except DexTouchError:
            views = []  # reported by the station topic
        return [topic_message("cameras", views)]

    async def _taxel_messages(self) -> list[Message]:
        try:
            content, _ = await self.upstream("acquisition").content(station_api.TAXELS_PATH)
            _, arrays = unpack(content, max_bytes=MAX_TAXEL_BYTES)
        except DexTouchError as error:
            return [topic_message("taxels_lost", error.message)]
        pressures = {side: arrays.get(f"tactile_{side}") for side in SIDES}
        return [
            taxel_message(side, array) for side, array in pressures.items() if array is not None
        ]
