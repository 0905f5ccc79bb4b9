"""Worlds in which policies act: the protocol, rollouts, and their HTTP routes."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.worlds.app import create_serving_app as create_serving_app
    from dextouch.worlds.app import create_world_app as create_world_app
    from dextouch.worlds.app import serve_worlds as serve_worlds
    from dextouch.worlds.baseline import CopyFirstWorld as CopyFirstWorld
    from dextouch.worlds.fixed_batch import FixedBatchWorld as FixedBatchWorld
    from dextouch.worlds.settings import WorldServiceSettings as WorldServiceSettings
    from dextouch.worlds.world import BatchWorld as BatchWorld
    from dextouch.worlds.world import QuickWorld as QuickWorld
    from dextouch.worlds.world import ReconstructingWorld as ReconstructingWorld
    from dextouch.worlds.world import StartedRollout as StartedRollout
    from dextouch.worlds.world import State as State
    from dextouch.worlds.world import SteppedRollout as SteppedRollout
    from dextouch.worlds.world import World as World
else:
    __getattr__, __dir__, __all__ = lazy_exports(__name__)
