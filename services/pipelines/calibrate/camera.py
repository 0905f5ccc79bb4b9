"""Command `dextouch station calibrate camera`: intrinsics from photos of a board.

The photos lie in a folder, or are collected first: from a watched folder or a running station.
"""

import argparse

from dextouch.clients import HttpLink
from dextouch.errors import InvalidInputError
from services.alignment.station_calibration.camera_views import (
    Session,
    calibrate_photos,
    folder_arrivals,
    station_arrivals,
)


def calibrate(options: argparse.Namespace) -> dict[str, object]:
    """Calibrate from the photos of a folder; coverage and advice are written in any case.

    With `--url` or `--watch` photos are collected first.
    """
    if options.watch and options.url is not None:
        raise InvalidInputError("got --watch and --url, expected one of the two")
    if options.watch or options.url is not None:
        _collect(options)
    return calibrate_photos(options)


def _collect(options: argparse.Namespace) -> None:
    """Collect until coverage is sufficient, or Ctrl-C."""
    session = Session(options, None if options.url is None else options.photos)
    print("Ctrl-C ends the collection and calibrates with the photos so far")
    try:
        if options.url is None:
            session.collect(folder_arrivals(options.photos))
            return
        link = HttpLink(options.url, api_key=options.key)
        session.collect(station_arrivals(link, options.camera))
    except KeyboardInterrupt:
        print(f"stopped with {len(session.views)} views")
