"""HTTP service of the twin and its baseline world."""

from functools import partial
from typing import Any

from pydantic import Field

from dextouch.serving import load_settings, service_config
from dextouch.worlds import CopyFirstWorld, World, WorldServiceSettings, serve_worlds
from services.twin.settings import TwinSettings


class TwinServiceSettings(WorldServiceSettings):
    """Serve the rollouts of the physics twin, and of a baseline that copies the first step.

    Example:
      dextouch twin serve --port 8084
    """

    model_config = service_config("twin", "dextouch twin serve")

    scene: TwinSettings = Field(default=TwinSettings(), description="settings of the scene")


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
