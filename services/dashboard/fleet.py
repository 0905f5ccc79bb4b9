"""Stations of a dashboard by name, and the wall that shows all of them at once."""

import asyncio
import time
from collections.abc import Mapping
from datetime import datetime
from operator import not_
from typing import Annotated

import httpx
import numpy as np
from fastapi import Query
from pydantic import Field, ValidationError

from dextouch.errors import DexTouchError, InvalidInputError, NotFoundError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import CameraLive, HealthLevel, HoursByField, StationOverview, first_problems
from dextouch.streams import unpack
from dextouch.tactile import LayoutDescription
from dextouch.tactile.layout import NUM_TAXELS, SIDES
from services.dashboard.feeds import MAX_LIVE_BYTES, Feeds, Message, Topic, topic_message
from services.dashboard.settings import DashboardSettings
from services.dashboard.station_view import trouble
from services.dashboard.upstream import Upstream

FLEET_TAXELS_MESSAGE = 3
# Trouble comes first.
ORDER: tuple[HealthLevel, ...] = ("ERROR", "STALE", "WARN", "OK")
HOURS_PERIOD_S = 10.0
# By this much an answer may be older than the time that the station had for it.
GRACE_S = 0.1


class Tile(FrozenModel):
    """A station on the wall; of one that does not answer name, level, cause and advice are known.

    `hours_today` are those of the store's episodes of this station; None where unknown.
    """

    name: str
    level: HealthLevel = "STALE"
    cause: str = "no answer yet"
    advice: str = ""
    recorder: str = "unknown"
    task: str | None = None
    duration_s: float | None = None
    hours_today: float | None = None
    disk_left_s: float | None = None
    disk_free_bytes: float | None = None
    camera: CameraLive | None = None
    gloves: tuple[str, ...] = ()
    layouts: dict[str, LayoutDescription] = Field(default={}, exclude_if=not_)


class WatchedStation:
    """Newest overview of one station, which is asked at most once at a time."""

    def __init__(self, name: str, feeds: Feeds, settings: DashboardSettings) -> None:
        self.name = name
        self._feeds = feeds
        self._timeout_s = settings.live_timeout_s
        self._asking: asyncio.Task[None] | None = None
        self._overview: StationOverview | None = None
        self._pressures: dict[str, np.ndarray] = {}
        self._answered_s = float("-inf")
        self._failure = ("no answer yet", "")
        self._hours_today: float | None = None
        self._hours_due_s = float("-inf")

    def ask(self) -> "asyncio.Task[None]":
        """Ask for an overview, or go on waiting for the answer."""
        if self._asking is None or self._asking.done():
            self._asking = asyncio.create_task(self._ask())
        return self._asking

    @property
    def _address(self) -> str:
        has = self._feeds.has("acquisition")
        return self._feeds.upstream("acquisition").address if has else ""

    async def _ask(self) -> None:
        try:
            answer = await self._feeds.upstream("acquisition").send(
                "GET", "/v1/live/overview", timeout_s=self._timeout_s
            )
            fields, arrays = unpack(answer.content, max_bytes=MAX_LIVE_BYTES)
            self._overview = StationOverview.model_validate(fields, extra="ignore")
            self._pressures = arrays
            self._answered_s = time.monotonic()
        except ValidationError as error:
            self._overview = None
            found = InvalidInputError(f"unexpected overview ({first_problems(error)})")
            self._failure = trouble(found, self._address)
        except DexTouchError as error:
            self._overview, self._failure = None, trouble(error, self._address)

    async def ask_hours(self, store: Upstream) -> None:
        """Hours of today's episodes, asked every 10 s; unknown where the store does not say."""
        if time.monotonic() < self._hours_due_s:
            return
        self._hours_due_s = time.monotonic() + HOURS_PERIOD_S
        now = datetime.now().astimezone()
        offset = now.utcoffset()
        offset_min = 0 if offset is None else round(offset.total_seconds() / 60)
        query = httpx.QueryParams(station=self.name, utc_offset_min=offset_min)
        path = f"/v1/catalog/hours/day?{query}"
        try:
            found = await store.read(HoursByField, path)
        except DexTouchError:
            self._hours_today = None
            return
        today = [row for row in found.rows if row.value == now.date().isoformat()]
        self._hours_today = sum(row.accepted_h + row.not_reviewed_h for row in today)

    def is_known(self) -> bool:
        """Whether the overview is new enough to be shown."""
        age_s = time.monotonic() - self._answered_s
        return self._overview is not None and age_s <= self._timeout_s + GRACE_S

    def tile(self) -> Tile:
        """The station now."""
        overview = self._overview
        if overview is None or not self.is_known():
            cause, advice = ("no answer", "") if overview else self._failure
            return Tile(name=self.name, cause=cause, advice=advice, hours_today=self._hours_today)
        fresh = [camera for camera in overview.cameras if camera.age_s <= self._timeout_s]
        # The name is the dashboard's own for the station; layouts would be dumped as text.
        shown = overview.model_dump(include=Tile.model_fields.keys() - {"name", "layouts"})
        return Tile(
            **shown,
            name=self.name,
            hours_today=self._hours_today,
            camera=fresh[0] if fresh else None,
            gloves=tuple(side for side in SIDES if f"tactile_{side}" in self._pressures),
            layouts=overview.layouts,
        )

    def taxel_message(self, index: int) -> bytes:
        """Encode the pressures of both hands, those of a glove that is not heard as zeros.

        uint8 kind (3), uint8 place in the list, uint16 number of taxels of the left hand, then
        float32 kPa of the left and of the right hand, little endian.
        """
        none = np.zeros(NUM_TAXELS, dtype="<f4")
        known = self._pressures if self.is_known() else {}
        hands = [known.get(f"tactile_{side}", none) for side in SIDES]
        header = bytes([FLEET_TAXELS_MESSAGE, index]) + len(hands[0]).to_bytes(2, "little")
        return header + np.concatenate(hands).astype("<f4").tobytes()


class Fleet:
    """The stations of a dashboard, of which pages choose one by name."""

    def __init__(self, stations: Mapping[str, Feeds], settings: DashboardSettings) -> None:
        self._stations = dict(stations)
        self._watched = [WatchedStation(name, feeds, settings) for name, feeds in stations.items()]
        self._period_s = settings.fleet_period_s
        self.topic = Topic("fleet", settings.fleet_period_s, self._messages)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the stations."""
        return tuple(self._stations)

    def of(self, station: Annotated[str | None, Query(max_length=64)] = None) -> Feeds:
        """Feeds of a station; by default of the first one.

        Raises:
            NotFoundError: no such station.
        """
        if station is None:
            return next(iter(self._stations.values()))
        if station not in self._stations:
            raise NotFoundError(
                f"station {station!r}: not one of this dashboard; it shows "
                f"{', '.join(self._stations)} (settings: station, stations)"
            )
        return self._stations[station]

    def topics(self, station: str | None) -> dict[str, Topic]:
        """Topics of a page: those of a station, and the wall."""
        return {**self.of(station).topics, self.topic.name: self.topic}

    async def _messages(self) -> list[Message]:
        """The tiles, trouble first, and the pressures of each; slow stations are not waited for."""
        store = self.of().store
        polls = [watched.ask() for watched in self._watched]
        if store is not None:
            polls += [asyncio.create_task(one.ask_hours(store)) for one in self._watched]
        await asyncio.wait(polls, timeout=self._period_s)
        tiles = [(watched.tile(), watched) for watched in self._watched]
        tiles.sort(key=lambda row: (ORDER.index(row[0].level), row[0].name))
        pressures = [one.taxel_message(index) for index, (_, one) in enumerate(tiles)]
        return [topic_message("fleet", [tile for tile, _ in tiles]), *pressures]
