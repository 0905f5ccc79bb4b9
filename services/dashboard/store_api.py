"""Client side of the episode store API: the newest takes as views."""

from collections.abc import Mapping
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from dextouch.errors import UnavailableError
from dextouch.schemas import (
    EpisodeDetail,
    EpisodeList,
    EpisodeSummary,
    RecordingList,
    RecordingSummary,
)
from services.dashboard.upstream import Upstream
from services.dashboard.views import TakeView

RECORDINGS_PATH = "/v1/recordings"
EPISODES_PATH = "/v1/episodes"
OUTCOMES = {True: "success", False: "failure", None: "not judged"}

ModelT = TypeVar("ModelT", bound=BaseModel)


async def newest_recordings(store: Upstream, count: int) -> list[RecordingSummary]:
    """The last recordings by id, in descending order."""
    page = await _last_page(store, RECORDINGS_PATH, count, RecordingList)
    return list(reversed(page.recordings))


async def newest_episodes(store: Upstream, count: int) -> list[EpisodeSummary]:
    """The last episodes by id, in descending order."""
    page = await _last_page(store, EPISODES_PATH, count, EpisodeList)
    return list(reversed(page.episodes))


async def clock_words(store: Upstream, episode_id: str) -> str:
    """Summary of an episode's clock fits; empty if there are none."""
    answer = await store.json("GET", f"{EPISODES_PATH}/{episode_id}")
    clocks = _read(EpisodeDetail, answer).attributes.clocks
    residuals_ms = [clock.residual_rms_ms for clock in clocks if clock.residual_rms_ms is not None]
    skews_ppm = [abs(clock.skew_ppm) for clock in clocks if clock.skew_ppm is not None]
    if not residuals_ms or not skews_ppm:
        return ""
    lost = sum(clock.num_dropped for clock in clocks)
    doubted = ", ".join(clock.stream for clock in clocks if clock.warnings)
    return (
        f"skew to {max(skews_ppm):.0f} ppm, residual to {max(residuals_ms):.2f} ms, "
        f"{lost} samples lost{f'; unreliable times: {doubted}' if doubted else ''}"
    )


def recording_view(item: RecordingSummary) -> TakeView:
    """View of a recording."""
    num_samples = sum(item.num_samples.values())
    return TakeView(
        kind="recording",
        name=item.recording_id,
        task=item.task,
        domain=item.domain,
        operator=item.operator,
        consent=item.consent,
        outcome=OUTCOMES[item.success],
        size=f"{item.duration_s:.1f} s, {num_samples} samples, {len(item.num_samples)} streams",
    )


def episode_view(item: EpisodeSummary, clocks: Mapping[str, str]) -> TakeView:
    """View of an episode."""
    return TakeView(
        kind="episode",
        name=item.episode_id,
        task=item.task,
        domain=item.domain,
        operator=item.operator,
        consent=None,
        outcome=OUTCOMES[item.success],
        size=f"{item.duration_s:.1f} s, {item.num_steps} steps",
        clocks=clocks.get(item.episode_id, ""),
    )


async def _last_page(store: Upstream, path: str, count: int, model: type[ModelT]) -> ModelT:
    """Last page of a list, which the store sorts by id in ascending order."""
    first = await store.json("GET", f"{path}?limit={count}")
    total = first.get("num_matching", 0) if isinstance(first, dict) else 0
    if not isinstance(total, int) or total <= count:
        return _read(model, first)
    return _read(model, await store.json("GET", f"{path}?limit={count}&offset={total - count}"))


def _read(model: type[ModelT], answer: object) -> ModelT:
    try:
        return model.model_validate(answer)
    except ValidationError as error:
        raise UnavailableError(
            f"episode_store: unexpected response ({error.error_count()} invalid fields)"
        ) from error
