"""Metrics that the services export, with their labels, collected from running applications."""

import asyncio
from collections import defaultdict

from prometheus_client.parser import text_string_to_metric_families

from dextouch.schemas import StationHealth
from services.acquisition.health.metrics import STATION_FIGURES, HealthCollector
from services.dashboard.upstream import Upstream
from tests.contracts.service_apps import APPS, client_of, open_websocket
from tests.unit.worlds.fakes import actions

START = {"world": "sum", "task": "stand_bottle", "seed": 1, "instruction": "stand it up"}
# Of streams that the mock station has.
JUDGED = ("dextouch_rate_hz", "dextouch_clock_sigma_seconds", "dextouch_dead_taxels_ratio")
LIMIT_S = 120


def samples_of(text):
    """Label names by sample name of one scrape."""
    found = defaultdict(set)
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            found[sample.name] |= set(sample.labels)
    return found


async def scraped(client):
    answer = await client.get("/metrics")
    assert answer.status_code == 200
    return samples_of(answer.text)


async def advance_a_rollout(client):
    as_json = {"accept": "application/json"}
    started = await client.post("/v1/rollouts", json=START, headers=as_json)
    assert started.status_code == 201, started.text
    rollout_id = started.json()["fields"]["rollout"]["id"]
    given = {"actions": actions(4).tolist()}
    answer = await client.post(f"/v1/rollouts/{rollout_id}/chunks/0", json=given)
    assert answer.status_code == 200, answer.text


async def until_streams_are_judged(client):
    async with asyncio.timeout(LIMIT_S):
        while set(JUDGED) - set(await scraped(client)):  # noqa: ASYNC110 - over HTTP
            await asyncio.sleep(0.2)


async def exported_metrics(folder):
    """Label names by sample name, of all services together."""
    found = defaultdict(set)
    for name, make in APPS.items():
        place = folder / name
        place.mkdir()
        more = {}
        if name == "dashboard":
            store = client_of(APPS["episode_store"](place))
            more["upstreams"] = {"episode_store": Upstream("episode_store", store)}
        app = make(place, **more)
        async with app.router.lifespan_context(app), client_of(app) as client:
            await client.get("/v1/episode_store/episodes")
            if name == "worlds":
                await advance_a_rollout(client)
                await open_websocket(app, "/v1/openpi")
            if name == "acquisition":
                await until_streams_are_judged(client)
            for sample, labels in (await scraped(client)).items():
                found[sample] |= labels
    # Figures and findings that a station has only in trouble.
    figures = dict.fromkeys(STATION_FIGURES, 0.0)
    health = StationHealth(station="x", level="OK", figures=figures, streams=(), devices=())
    for metric in HealthCollector(lambda: health, lambda: {("head", "lost"): 1}).collect():
        for sample in metric.samples:
            found[sample.name] |= set(sample.labels)
    return dict(found)
