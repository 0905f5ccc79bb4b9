"""`dextouch twin serve`: flags and environment (DEXTOUCH_TWIN_…) in, the twin over HTTP out."""

from dextouch.serving.settings import load_settings, service_config
from dextouch.worlds.serve import WorldServiceSettings, serve_worlds
from services.twin.settings import TwinSettings
from services.twin.world import TwinWorld


class TwinServiceSettings(WorldServiceSettings):
    """A rollout service with the twin as its world."""

    model_config = service_config("twin")

    scene: TwinSettings = TwinSettings()


def serve(arguments: list[str]) -> None:
    """Serve until SIGINT or SIGTERM.

    Raises:
        InvalidInputError: settings that do not fit.
    """
    settings = load_settings(TwinServiceSettings, arguments)
    world = TwinWorld(settings.scene)
    serve_worlds({world.description.name: world}, settings, name="twin")
