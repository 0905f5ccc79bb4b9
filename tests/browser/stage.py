"""A whole platform with content, for tests and pictures of all screens of the dashboard."""

import json
import time
from datetime import UTC, datetime, timedelta

import httpx
import numpy as np

from dextouch.clients import RolloutClient
from dextouch.episodes import EpisodeStore
from dextouch.schemas import Review
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.acquisition.mocks import pattern
from services.alignment.app import create_app as create_alignment
from services.alignment.settings import AlignmentSettings
from services.alignment.station_calibration.record import write_entry
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from services.evaluation.rating.app import create_rating_app
from services.evaluation.settings import RatingSettings, StudyServiceSettings
from services.evaluation.studies.app import create_app as create_studies
from tests.browser import played_items
from tests.browser.test_rollouts_page import START, NoisyWorld
from tests.unit.episode_store.episodes import write_recording, write_take
from tests.unit.evaluation import toy
from tests.unit.evaluation.study_rows import write_study
from tests.unit.evaluation.test_rating_app import RUBRICS
from tests.unit.evaluation.toy_store import write as write_toy
from tests.unit.worlds.fakes import actions

KEY = "a-key-of-some-length"
OPERATOR = {"name": "ada", "key": KEY, "scopes": ("operate",)}
# Nobody listens there.
DEAD = "http://127.0.0.1:9"
INSTRUCTIONS = {
    "stand_bottle": "Stand the bottle up.",
    "fold_towel": "Fold the towel twice, with its edges on each other.",
    "plug_charger": "Plug the charger into the left socket of the power strip, without looking.",
}
BOX_M = [0, 0, 0, 0.03, 0.03, 0.1]
OBJECTS = {
    "tasks": {
        "stand_bottle": [
            {"name": "bottle", "box_m": BOX_M, "click": {"up": "x", "heading": "z"}},
            {"name": "mat", "box_m": BOX_M, "click": {"symmetric": True}},
        ]
    }
}
STREAMS = {
    "desk_1": ("tactile_left", "tactile_right", "keypoints_left", "wrist_left", "camera_head"),
    "desk_2": ("tactile_left", "camera_head"),
}


def write_store(folder):
    """Takes of three tasks and two operators, odd and failed ones, reviews, and a trash."""
    store = EpisodeStore(folder)
    now = datetime.now(UTC)
    for task_index, (task, instruction) in enumerate(INSTRUCTIONS.items()):
        for number in range(10):
            write_take(
                store,
                f"{task}-{number:02d}",
                # One is far too long.
                num_steps=220 if (task_index, number) == (0, 4) else 30 + number % 3,
                task=task,
                instruction=instruction,
                operator=("mika", "sanna")[number // 6],
                station=("desk_1", "desk_2")[task_index % 2],
                success=(None, True, True, False)[number % 4],
                consent=number != 7,
                started_at=now - timedelta(hours=7 * task_index, minutes=11 * number),
            )
    for number, verdict in enumerate(("accepted", "accepted", "rejected")):
        review = Review(
            verdict=verdict,
            reviewed_at=now,
            reviewer="kim",
            reason="interrupted or disturbed" if verdict == "rejected" else "",
        )
        store.set_review(f"fold_towel-{number:02d}-aligned", review)
    played_items.write_recording(store)
    played_items.write_episode(store, created_at=now)
    write_recording(store, "deleted-take", started_at=now)
    store.delete("deleted-take", kind="recording")
    for seed in (1, 2, 3):
        write_toy(store, toy.demonstration("reach", seed))


def serve_stations(station_process):
    """Two stations with mock devices, and one that nobody starts."""
    urls = {name: station_process(name, *streams).url for name, streams in STREAMS.items()}
    first, *others = urls
    return {
        "station": first,
        "acquisition_url": urls[first],
        "stations": {name: urls[name] for name in others} | {"desk_3": DEAD},
    }


def serve_store(serve, folder):
    write_store(folder / "store")
    (folder / "objects.json").write_text(json.dumps(OBJECTS))
    settings = EpisodeStoreSettings(
        store_url=str(folder / "store"), objects=folder / "objects.json"
    )
    return {
        "episode_store_url": serve(create_store(settings)),
        "goal_hours": {"stand_bottle": 0.02, "fold_towel": 0.01},
    }


def know_the_lens(folder):
    """Write the lens of the practice camera, as its own calibration would."""
    lens = {
        "K_head": pattern.K,
        "K_head_sigma_px": np.full(4, 0.2),
        "distortion_head": np.array([*pattern.DISTORTION, 0.0]),
        "image_size_head_px": np.array(pattern.SIZE_PX, dtype=float),
    }
    write_entry(folder, "K_head", lens, {})


def serve_alignment(serve, folder, station_url):
    alignment = AlignmentSettings(
        store_url=str(folder / "store"),
        num_workers=1,
        align_new=False,
        station_url=station_url,
        station_spool=folder / "spool",
        calibration_folder=folder / "calibration",
    )
    return {"alignment_url": serve(create_alignment(alignment))}


def serve_worlds_and_studies(serve, folder):
    write_study(folder / "studies" / "touch")
    studies = StudyServiceSettings(studies=folder / "studies")
    return {
        "world_model_url": serve(create_world_app({"sum": NoisyWorld()}, WorldServiceSettings())),
        "twin_url": DEAD,
        "studies_url": serve(create_studies(studies)),
    }


def serve_rating(serve, folder):
    (folder / "rubrics.toml").write_text(RUBRICS)
    rating = RatingSettings(
        store_url=str(folder / "store"),
        marks=folder / "ratings.sqlite",
        rubrics=folder / "rubrics.toml",
    )
    return {"rating_url": serve(create_rating_app(rating))}


def serve_dashboard(serve, folder, settings):
    """The dashboard of these services, which asks for a key."""
    settings = {
        "takes_goal": 20,
        "api_keys": (OPERATOR,),
        "audit_folder": folder / "audit",
    } | settings
    return serve(create_dashboard(DashboardSettings.model_validate(settings)))


def open_rollout(stack, world_url):
    """A rollout of which one chunk was imagined, open until `stack` ends."""
    client = stack.enter_context(RolloutClient(world_url, name="colour servo"))
    rollout = stack.enter_context(client.start(**START))
    rollout.step(actions(4, 0.1))


def record_a_take(station_url):
    """Record a second at a station and stop, so that its page shows a verdict."""
    prompt = {"task": "fold_towel", "instruction": INSTRUCTIONS["fold_towel"]}
    prompt |= {"domain": "human", "operator": "mika", "consent": True}
    with httpx.Client(base_url=station_url, timeout=60, trust_env=False) as client:
        for action, body in (("arm", prompt), ("record", {}), ("stop", {})):
            client.post(f"/v1/recorder/{action}", json=body).raise_for_status()
            time.sleep(1.0 if action == "record" else 0.0)
