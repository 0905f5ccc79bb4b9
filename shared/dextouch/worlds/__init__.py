"""Worlds in which policies act: the protocol, rollouts, and their HTTP routes."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.worlds.baseline import CopyFirstWorld
    from dextouch.worlds.serve import WorldServiceSettings, create_world_app, serve_worlds
    from dextouch.worlds.world import BatchWorld, StartedRollout, State, SteppedRollout, World
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "baseline": "CopyFirstWorld",
            "serve": "WorldServiceSettings create_world_app serve_worlds",
            "world": "BatchWorld StartedRollout State SteppedRollout World",
        },
    )

__all__ = [
    "BatchWorld",
    "CopyFirstWorld",
    "StartedRollout",
    "State",
    "SteppedRollout",
    "World",
    "WorldServiceSettings",
    "create_world_app",
    "serve_worlds",
]
