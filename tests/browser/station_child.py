"""A station with some of the pattern's mock devices in a process of its own; prints its URL."""

import asyncio
import os
import sys
from pathlib import Path

from services.acquisition.app import create_app
from services.acquisition.mocks import pattern
from services.acquisition.settings import AcquisitionSettings
from services.pipelines.servers import bind, serve_all


def main(spool, name, *streams):
    whole = pattern.pattern_streams
    pattern.pattern_streams = lambda round_s=pattern.ROUND_S, **given: [
        stream for stream in whole(round_s, **given) if stream.descriptor.name in streams
    ]
    app = create_app(AcquisitionSettings(spool=Path(spool), mock=True, station=name))
    place = bind(name, host="127.0.0.1", port=0)
    asyncio.run(
        serve_all(
            [(place, app)],
            stop=asyncio.Event(),
            on_ready=lambda: os.write(1, f"{place.url}\n".encode()),
            grace_s=1,
        )
    )


main(*sys.argv[1:])
