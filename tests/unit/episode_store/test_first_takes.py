"""Findings of the first takes of a task, of which there are too few to be compared."""

import httpx
import pytest

from dextouch.episodes import EpisodeStore
from services.episode_store.app import create_app
from tests.unit.episode_store.episodes import write_episode, write_recording

CAUSE = "camera_head: 2.10 s without a sample, expected at most 0.5 s"


@pytest.fixture
def store(settings):
    return EpisodeStore(settings.store_url)


async def flagged(settings, kind="take"):
    """What Review lists: the findings of each item, without those about the outcome."""
    transport = httpx.ASGITransport(app=create_app(settings))
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as http:
        query = {"kind": kind, "flagged": "true"}
        items = (await http.get("/v1/catalog/items", params=query)).json()["items"]
    return {
        item["id"]: [(one["code"], one["message"]) for one in item["findings"]] for item in items
    }


def episode_of(store, recording_id, **changes):
    lineage = [{"kind": "recording", "id": recording_id}]
    changes = {"origin": "recorded", "domain": "human", "lineage": lineage} | changes
    write_episode(store, f"{recording_id}-episode", **changes)


def clock(residual_ms, **changes):
    fields = {"stream": "camera_head", "method": "device", "num_samples": 100}
    return [fields | {"residual_rms_ms": residual_ms} | changes]


@pytest.mark.long
@pytest.mark.parametrize("is_aligned", [False, True])
@pytest.mark.parametrize("kind", ["take", "recording", "episode"])
async def test_an_incomplete_take_is_to_be_reviewed(settings, store, is_aligned, kind):
    about = {"complete": False, "incomplete_cause": CAUSE}
    write_recording(store, "take-1", success=True, **about)
    write_recording(store, "take-2", success=True)
    if is_aligned:
        episode_of(store, "take-1", **about)
    found = await flagged(settings, kind)
    # Of an aligned recording the findings are those of its episode.
    named = {"take": "take-1", "recording": "take-1", "episode": "take-1-episode"}[kind]
    is_listed = kind == "take" or is_aligned == (kind == "episode")
    assert set(found) == ({named} if is_listed else set())
    for findings in found.values():
        assert findings == [("incomplete", f"incomplete: {CAUSE}")]


async def test_an_episode_that_an_older_release_aligned_is_as_incomplete_as_its_recording(
    settings, store
):
    write_recording(store, "take-1", success=True, complete=False, incomplete_cause=CAUSE)
    episode_of(store, "take-1")
    for kind, name in (("take", "take-1"), ("episode", "take-1-episode")):
        assert await flagged(settings, kind) == {name: [("incomplete", f"incomplete: {CAUSE}")]}


async def test_incomplete_takes_come_before_those_in_doubt(settings, store):
    write_recording(store, "a-not-judged")
    write_recording(store, "b-incomplete", complete=False, incomplete_cause=CAUSE)
    transport = httpx.ASGITransport(app=create_app(settings))
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as http:
        query = {"flagged": "true", "sort": "findings", "descending": "true"}
        items = (await http.get("/v1/catalog/items", params=query)).json()["items"]
    assert [item["id"] for item in items] == ["b-incomplete", "a-not-judged"]


@pytest.mark.parametrize(
    ("num_refused", "is_listed"), [(1, False), (2, True)], ids=["9 of 10 kept", "9 of 11 kept"]
)
async def test_a_first_take_that_lost_over_a_tenth_of_its_steps(
    settings, store, num_refused, is_listed
):
    write_recording(store, "take-1", success=True)
    episode_of(store, "take-1", quality={"num_steps_refused": num_refused})
    found = await flagged(settings)
    message = "share of steps kept 81.8%, expected at least 90%"
    assert found == ({"take-1": [("beyond_limit", message)]} if is_listed else {})


@pytest.mark.long
@pytest.mark.parametrize(
    ("residual_ms", "changes", "is_listed"),
    [
        (9.9, {}, False),
        # docs/health.md: clock_residual is an ERROR from 10 ms on.
        (10.0, {}, True),
        (38.0, {}, True),
        # The episode's 15 Hz images are dated by counting: half a period, 33 ms, is the limit.
        (33.0, {"method": "counting"}, False),
        (38.0, {"method": "counting"}, True),
    ],
)
async def test_a_first_take_whose_arrivals_scatter_as_live_health_refuses_it(
    settings, store, residual_ms, changes, is_listed
):
    write_recording(store, "take-1", success=True)
    episode_of(store, "take-1", clocks=clock(residual_ms, **changes))
    found = await flagged(settings)
    assert set(found) == ({"take-1"} if is_listed else set())
    for findings in found.values():
        assert [code for code, _ in findings] == ["beyond_limit"]
        assert f"camera_head: arrivals scatter by {residual_ms:.1f} ms" in findings[0][1]
