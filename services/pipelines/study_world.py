"""Child process that serves one world of a study on a free port of this machine.

It answers once with the URL and name of the world, and ends when its parent does.
"""

import sys
from pathlib import Path
from typing import Any

from dextouch.errors import DexTouchError
from dextouch.serving import configure_logging, serve_parent
from dextouch.worlds import (
    BatchWorld,
    FixedBatchWorld,
    World,
    WorldServiceSettings,
    create_world_app,
)
from services.pipelines.servers import served


def open_named(kind: str, value: str) -> World[Any]:
    """The twin, or the world model of a checkpoint or shipped with the package, on one thread."""
    if (kind, value) == ("builtin", "twin"):
        from services.twin.settings import TwinSettings
        from services.twin.world import TwinWorld

        return TwinWorld(TwinSettings())
    import torch

    from services.world_model.shipped_checkpoints import default_checkpoint
    from services.world_model.world import open_world

    torch.set_num_threads(1)
    return open_world(default_checkpoint() if kind == "builtin" else Path(value))


def main() -> None:
    """Serve `builtin NAME` or `checkpoint PATH` until standard input closes.

    The third argument is the number of rollouts in flight, the size of every batch: the rollouts
    of an interrupted study meet others than before, and must not round differently for that.
    """
    requests, answer = serve_parent(niceness=0)
    kind, value, batch_size = sys.argv[1:]
    configure_logging(service=f"world {value}", log_format="auto", level="warning")
    try:
        world = open_named(kind, value)
    except DexTouchError as error:
        answer({"refused": error.message})
        return
    if isinstance(world, BatchWorld):
        world = FixedBatchWorld(world, int(batch_size))
    name = world.description.name
    app = create_world_app({name: world}, WorldServiceSettings())
    with served({name: app}) as urls:
        answer({"url": urls[name], "world": name})
        for _ in requests:
            pass


if __name__ == "__main__":
    main()
