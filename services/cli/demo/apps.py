"""Service applications of the demo."""

from pathlib import Path
from typing import Any

from fastapi import FastAPI

from dextouch.worlds import CopyFirstWorld, World, WorldServiceSettings, create_world_app
from services.alignment.app import create_app as create_alignment
from services.alignment.settings import AlignmentSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from services.twin.settings import TwinSettings
from services.twin.world import TwinWorld


def build_apps(store: str, jobs_folder: Path, world_model: World[Any]) -> dict[str, FastAPI]:
    """Create store, alignment, the twin as the real world, and the imagined worlds.

    Args:
        store: store of recordings and episodes.
        jobs_folder: folder of alignment jobs.
        world_model: served beside the copy-first baseline.
    """
    imagined: dict[str, World[Any]] = {
        "world_model": world_model,
        "copy-first": CopyFirstWorld.beside(world_model.description),
    }
    return {
        "episode_store": create_store(EpisodeStoreSettings(store_url=store)),
        "alignment": create_alignment(
            AlignmentSettings(
                store_url=store, jobs_folder=jobs_folder, align_new=False, log_level="warning"
            )
        ),
        "twin": create_world_app(
            {"twin": TwinWorld(TwinSettings(cameras=("camera_head",)))},
            WorldServiceSettings(),
            name="twin",
        ),
        "imagined": create_world_app(imagined, WorldServiceSettings(), name="imagined"),
    }
