"""Panels of the page: what each shows, polled from the other services for all viewers."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import structlog
from jaxtyping import Float32
from pydantic_core import to_json

from dextouch.errors import DexTouchError, InvalidInputError, NotFoundError, UnknownNameError
from dextouch.frozen_model import FrozenModel
from dextouch.hands import CHAINS, WRIST_NODE, chain_indices
from dextouch.schemas import (
    CameraList,
    CameraLive,
    EpisodeDetail,
    EpisodeList,
    EpisodeSummary,
    HealthLevel,
    RecorderStatus,
    RecordingList,
    RecordingSummary,
    StationHealth,
    UploadStatus,
)
from dextouch.streams import unpack
from dextouch.tactile import CONTACT_THRESHOLD_KPA, colour
from dextouch.tactile.layout import DEXTOUCH_V1, SIDES, Side
from services.dashboard.settings import DashboardSettings
from services.dashboard.station_view import (
    RecorderView,
    StationView,
    TakeStateView,
    last_take,
    recorder_view,
    silent_view,
    station_view,
)
from services.dashboard.upstream import Upstream

# Binary messages of live taxels and poses, and the layout by which the page draws them.

# Of the taxel maps.
FULL_SCALE_KPA = 40.0
RAMP_STEPS = 128
# First byte of a binary message.
TAXEL_MESSAGE, POSE_MESSAGE = 1, 2


def skeleton_bones() -> list[tuple[int, int]]:
    """Pairs of keypoints that a bone connects, from `dextouch.hands`."""
    chains = [[WRIST_NODE, *chain_indices(chain)] for chain in CHAINS]
    return [bone for chain in chains for bone in pairwise(chain)]


def heatmap_layout() -> dict[str, object]:
    """Positions of the taxels of `dextouch_v1` and the colour map, from `dextouch.tactile`.

    Those of other gloves the page finds from their layout (`static/taxels.js`).
    """
    layout = DEXTOUCH_V1
    taxels = np.arange(layout.num_taxels, dtype=np.float32)
    canvases = {side: layout.hand_canvas(taxels, side=side) for side in SIDES}
    rows, columns = canvases["right"].shape
    pressures_kpa = np.linspace(0.0, FULL_SCALE_KPA, RAMP_STEPS)
    return {
        "rows": rows,
        "columns": columns,
        # NaN sorts last: the first ones are the cells of the taxels in their order.
        "cells": {s: np.argsort(c.ravel())[: len(taxels)].tolist() for s, c in canvases.items()},
        "pads": [
            {
                "part": pad.part,
                "start": start,
                "rows": pad.rows,
                "columns": pad.columns,
                "taxel_area_mm2": 1e6 * pad.taxel_area_m2,
            }
            for pad, start in zip(layout.pads, layout.starts, strict=True)
        ],
        "num_raw_cells": layout.num_raw_cells,
        "raw_cells": {s: layout.raw_indices(s).tolist() for s in SIDES},
        "ramp": colour(pressures_kpa, full_scale_kpa=FULL_SCALE_KPA).tolist(),
        "full_scale_kpa": FULL_SCALE_KPA,
        "contact_kpa": CONTACT_THRESHOLD_KPA,
    }


def taxel_message(side: Side, pressures_kpa: np.ndarray | None) -> bytes:
    """Encode pressures: uint8 kind, uint8 side, uint16 count, then float32 kPa, little endian.

    None, of a glove that is not heard, has the count 0: an old picture must not stay.
    """
    values = np.empty(0) if pressures_kpa is None else pressures_kpa
    header = bytes([TAXEL_MESSAGE, SIDES.index(side)]) + len(values).to_bytes(2, "little")
    return header + np.ascontiguousarray(values, dtype="<f4").tobytes()


def pose_message(ages_s: Mapping[str, float | None], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Encode poses: uint8 kind, uint8 0, uint16 length of a list in JSON, the list, float32 values.

    The list holds name, age and number of values of each stream; spaces make its length a multiple
    of 4. Streams without a pose at this moment have 0 values.
    """
    values = {name: np.ravel(arrays.get(name, ())).astype("<f4") for name in ages_s}
    rows = to_json([(name, age_s, values[name].size) for name, age_s in ages_s.items()])
    rows += b" " * (-len(rows) % 4)
    header = bytes([POSE_MESSAGE, 0]) + len(rows).to_bytes(2, "little")
    return header + rows + b"".join(part.tobytes() for part in values.values())


logger = structlog.get_logger(__name__)

# Pressures of two gloves of 4096 taxels, and their layouts as JSON.
MAX_LIVE_BYTES = 256 * 1024
MAX_HISTORY_BYTES = 1024 * 1024
# Of the small plots: two minutes, two rows a point.
TREND_ROWS = 120
TREND_PERIOD_S = 2.0
NEWEST = "sort=time&descending=true&limit=6"
# Intervals of a study take seconds; its other routes wait meanwhile.
STUDY_TIMEOUT_S = 60.0
OUTCOMES = {True: "success", False: "failure", None: "not judged"}
# In place of a picture.
SILENT = "no answer from the station"
# Of the station's recorder, which checks their bodies.
ACTIONS = ("arm", "record", "stop", "save", "discard", "rerecord", "session")
# A WebSocket message: text (JSON) or bytes.
Message = str | bytes


class ServiceView(FrozenModel):
    """Readiness of a service."""

    name: str
    level: HealthLevel
    message: str


class TakeView(FrozenModel):
    """A stored recording or episode; `consent` is None where unknown."""

    kind: Literal["recording", "episode"]
    name: str
    task: str
    domain: str
    operator: str | None
    consent: bool | None = None
    outcome: str
    size: str
    clocks: str = ""


class TakesView(FrozenModel):
    """The newest takes; `note` explains an empty list. `refused` ones are still at the station."""

    refused: tuple[UploadStatus, ...] = ()
    takes: tuple[TakeView, ...] = ()
    note: str = ""


class OverviewView(FrozenModel):
    """Everything that the page of a station shows."""

    name: str
    station: StationView
    services: tuple[ServiceView, ...]
    takes: tuple[TakeView, ...]
    takes_note: str
    refused: tuple[UploadStatus, ...]


class PadLayout(FrozenModel):
    """A pad of the hand, and the index of its first taxel."""

    part: str
    start: int
    rows: int
    columns: int
    taxel_area_mm2: float


class HeatmapLayout(FrozenModel):
    """How taxels and keypoints are drawn.

    Attributes:
        cells: of each taxel, its cell in the picture of a hand, row by row.
        raw_cells: of each taxel, its cell among those of a packet.
        ramp: red, green and blue from no pressure to `full_scale_kpa`.
        contact_kpa: pressure above which a taxel counts as touched.
        bones: pairs of keypoints that a bone connects.
    """

    rows: int
    columns: int
    cells: dict[Side, tuple[int, ...]]
    pads: tuple[PadLayout, ...]
    num_raw_cells: int
    raw_cells: dict[Side, tuple[int, ...]]
    ramp: tuple[tuple[int, int, int], ...]
    full_scale_kpa: float
    contact_kpa: float
    bones: tuple[tuple[int, int], ...]


@dataclass(eq=False)
class Topic:
    """A topic: its newest messages, fetched at most once a period for all of its viewers."""

    name: str
    period_s: float
    fetch: Callable[[], Awaitable[list[Message]]]
    _messages: list[Message] = field(default_factory=list)
    _due_s: float = float("-inf")
    _fetching: asyncio.Lock = field(default_factory=asyncio.Lock)

    @classmethod
    def of_json(cls, name: str, period_s: float, read: Callable[[], Awaitable[object]]) -> "Topic":
        """A topic with one message, the JSON of what `read` returns."""

        async def fetch() -> list[Message]:
            return [topic_message(name, await read())]

        return cls(name, period_s, fetch)

    async def newest(self) -> list[Message]:
        """Messages that are at most a period old; the same list while nothing changes."""
        now_s = asyncio.get_running_loop().time
        async with self._fetching:
            if (started_s := now_s()) >= self._due_s:
                try:
                    messages = await self.fetch()
                    if messages != self._messages:
                        self._messages = messages
                except Exception:
                    # Supervisor of a feed: a bad response must not end the page's updates.
                    logger.exception("topic_failed", topic=self.name)
                self._due_s = started_s + self.period_s
            return self._messages

    async def updates(self) -> AsyncIterator[list[Message]]:
        """Messages at first and whenever they change; a slow viewer skips to the newest ones."""
        seen: list[Message] = []
        while True:
            messages = await self.newest()
            if messages and messages is not seen:
                seen = messages
                yield messages
            await asyncio.sleep(max(0.0, self._due_s - asyncio.get_running_loop().time()))


class Feeds:
    """Reads everything that the page shows from the configured services."""

    def __init__(self, upstreams: Mapping[str, Upstream], settings: DashboardSettings) -> None:
        self._upstreams = upstreams
        self._live_timeout_s = settings.live_timeout_s
        self._clocks: dict[str, str] = {}
        topics = [
            Topic.of_json("station", settings.station_period_s, self.station),
            Topic.of_json("trends", TREND_PERIOD_S, self._trends),
            Topic("taxels", settings.taxel_period_s, self._taxel_messages),
            Topic("poses", settings.pose_period_s, self._pose_messages),
            Topic.of_json("cameras", settings.station_period_s, self._cameras),
            Topic.of_json("services", settings.list_period_s, self.services),
            Topic.of_json("takes", settings.list_period_s, self.takes),
            Topic.of_json("last_take", settings.list_period_s, self._last_take),
            Topic.of_json("studies", settings.list_period_s, self._studies),
        ]
        self.topics = {topic.name: topic for topic in topics}

    def has(self, name: str) -> bool:
        """Whether this dashboard was started with the URL of a service."""
        return name in self._upstreams

    @property
    def store(self) -> Upstream | None:
        """The episode store, if this dashboard has one."""
        return self._upstreams.get("episode_store")

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
        if not self.has("acquisition"):
            return StationView(
                note="This dashboard was started without a station "
                "(DEXTOUCH_DASHBOARD_ACQUISITION_URL)."
            )
        acquisition = self.upstream("acquisition")
        try:
            health, recorder = await asyncio.gather(
                acquisition.read(StationHealth, "/v1/health", timeout_s=self._live_timeout_s),
                acquisition.read(RecorderStatus, "/v1/recorder", timeout_s=self._live_timeout_s),
            )
        except DexTouchError as error:
            return silent_view(error, acquisition.address)
        return station_view(health, recorder)

    async def _trends(self) -> dict[str, list[float | None]]:
        """Rate of each stream in the last two minutes, as a share of the nominal one."""
        try:
            answer = await self.upstream("acquisition").send(
                "GET", f"/v1/health/history?format=msgpack&limit={TREND_ROWS}"
            )
            fields, arrays = unpack(answer.content, max_bytes=MAX_HISTORY_BYTES)
        except DexTouchError:
            return {}  # reported by the station topic
        rates_hz = arrays["streams"][:, fields["stream_series"].index("rate_hz")]
        return {
            name: _trend(rates_hz[index] / nominal_hz)
            for index, (name, nominal_hz) in enumerate(fields["nominal_rate_hz"].items())
        }

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

    async def _last_take(self) -> TakeStateView | None:
        try:
            acquisition = self.upstream("acquisition")
            return await last_take(acquisition, self._upstreams.get("alignment"))
        except DexTouchError:
            return None  # reported by the station topic

    async def _refused(self) -> tuple[UploadStatus, ...]:
        try:
            acquisition = self.upstream("acquisition")
            return await acquisition.read(tuple[UploadStatus, ...], "/v1/uploads?refused=true")
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
            recordings = await store.read(RecordingList, f"/v1/recordings?{NEWEST}")
            episodes = await store.read(EpisodeList, f"/v1/episodes?{NEWEST}")
            # Episodes are immutable: each is queried once.
            self._clocks = {
                item.episode_id: self._clocks[item.episode_id]
                if item.episode_id in self._clocks
                else await _clock_words(store, item.episode_id)
                for item in episodes.episodes
            }
        except DexTouchError as error:
            logger.warning("takes_not_listed", error=error.message)
            return TakesView(note=f"The store does not list its takes: {error.message}")
        takes = [
            TakeView(
                kind="episode",
                name=item.episode_id,
                size=f"{item.duration_s:.1f} s, {item.num_steps} steps",
                clocks=self._clocks[item.episode_id],
                **_labels(item),
            )
            for item in episodes.episodes
        ]
        takes += [
            TakeView(
                kind="recording",
                name=item.recording_id,
                size=f"{item.duration_s:.1f} s, {sum(item.num_samples.values())} samples, "
                f"{len(item.num_samples)} stream{'s' * (len(item.num_samples) != 1)}",
                consent=item.consent,
                **_labels(item),
            )
            for item in recordings.recordings
        ]
        return TakesView(takes=tuple(takes), note="" if takes else "Nothing stored yet.")

    async def operate(self, action: str, body: Mapping[str, Any]) -> RecorderView:
        """Perform a recorder action and return the recorder's new state.

        Raises:
            UnknownNameError: no such action.
            InvalidInputError: no outcome to save.
            DexTouchError: what the station refuses, such as a body that the action does not take.
        """
        if action not in ACTIONS:
            raise UnknownNameError("recorder action", action, list(ACTIONS))
        if action == "save" and "success" not in body:
            raise InvalidInputError(
                "save: got no outcome, expected success: true, false or null (not judged)"
            )
        status = await self.upstream("acquisition").read(
            RecorderStatus, f"/v1/recorder/{action}", method="POST", body=body
        )
        return recorder_view(status)

    async def _cameras(self) -> tuple[CameraLive, ...]:
        try:
            listed = await self.upstream("acquisition").read(
                CameraList, "/v1/live/cameras", timeout_s=self._live_timeout_s
            )
        except DexTouchError:
            return ()  # reported by the station topic
        return listed.cameras

    async def _studies(self) -> object:
        """The service's list of studies, or why there is none."""
        try:
            studies = self.upstream("studies")
            answer = await studies.send("GET", "/v1/studies", timeout_s=STUDY_TIMEOUT_S)
            return answer.json()
        except DexTouchError as error:
            return {"studies": (), "note": error.message}

    async def _taxel_messages(self) -> list[Message]:
        try:
            _, arrays = await self._live("taxels")
        except DexTouchError:
            return [topic_message("taxels_lost", SILENT)]  # why, the station topic reports
        return [taxel_message(side, arrays.get(f"tactile_{side}")) for side in SIDES]

    async def _pose_messages(self) -> list[Message]:
        try:
            fields, arrays = await self._live("poses")
            return [pose_message(fields["age_s"], arrays)]
        except DexTouchError:
            return [topic_message("poses_lost", SILENT)]  # why, the station topic reports

    async def _live(self, what: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """What the station shows now; it counts as unreachable if it takes too long."""
        answer = await self.upstream("acquisition").send(
            "GET", f"/v1/live/{what}", timeout_s=self._live_timeout_s
        )
        return unpack(answer.content, max_bytes=MAX_LIVE_BYTES)


def _labels(item: EpisodeSummary | RecordingSummary) -> dict[str, Any]:
    labels = item.model_dump(include={"task", "domain", "operator"})
    return labels | {"outcome": OUTCOMES[item.success]}


def _trend(shares: Float32[np.ndarray, " rows"]) -> list[float | None]:
    """The lower of every two rows, so that a short gap stays visible; the newest last."""
    pairs = shares[len(shares) % 2 :].reshape(-1, 2).min(axis=1)
    return [None if np.isnan(share) else round(float(share), 3) for share in pairs]


async def _clock_words(store: Upstream, episode_id: str) -> str:
    """Summary of an episode's clock fits; empty if there are none."""
    clocks = (await store.read(EpisodeDetail, f"/v1/episodes/{episode_id}")).attributes.clocks
    residuals_ms = [clock.residual_rms_ms for clock in clocks if clock.residual_rms_ms is not None]
    skews_ppm = [abs(clock.skew_ppm) for clock in clocks if clock.skew_ppm is not None]
    if not residuals_ms or not skews_ppm:
        return ""
    lost = sum(clock.num_dropped for clock in clocks)
    unreliable = ", ".join(clock.stream for clock in clocks if clock.warnings)
    return (
        f"skew to {max(skews_ppm):.0f} ppm, residual to {max(residuals_ms):.2f} ms, "
        f"{lost} samples lost{f'; unreliable times: {unreliable}' if unreliable else ''}"
    )


def topic_message(topic: str, data: object) -> str:
    """Encode a message of a topic as JSON; `data` may hold pydantic models."""
    return to_json({"topic": topic, "data": data}, inf_nan_mode="null").decode()
