"""HTTP service of the twin and its baseline world."""

from functools import partial
from typing import Any

from dextouch.serving import load_settings
from dextouch.worlds import CopyFirstWorld, World, serve_worlds
from services.twin.settings import TwinServiceSettings, TwinSettings


def twin_worlds(scene: TwinSettings) -> dict[str, World[Any]]:
    """The twin, and the baseline that every imagined world must beat."""
    # The settings can be shown without MuJoCo.
    from services.twin.world import TwinWorld

    twin = TwinWorld(scene)
    baseline = CopyFirstWorld.beside(twin.description)
    return {"twin": twin, baseline.description.name: baseline}


def serve(arguments: list[str]) -> None:
    """Serve until SIGINT or SIGTERM.

    Raises:
        InvalidInputError: invalid settings.
    """
    settings = load_settings(TwinServiceSettings, arguments)
    serve_worlds(partial(twin_worlds, settings.scene), settings, name="twin")
