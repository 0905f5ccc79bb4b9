"""Command `dextouch station bridge`: serves the samples of an SDK to stations until Ctrl-C."""

import argparse
import signal
import threading
from collections.abc import Sequence
from typing import get_args

from dextouch.command_line import write_result
from dextouch.errors import InvalidInputError
from dextouch.free_text import printable
from dextouch.tactile.layout import SIDES
from services.acquisition.sdk_bridges.libsurvive_trackers import LIBRARY as LIBSURVIVE
from services.acquisition.sdk_bridges.libsurvive_trackers import LibsurviveTrackers
from services.acquisition.sdk_bridges.lsl_stream import LslStream
from services.acquisition.sdk_bridges.manus_gloves import LIBRARY as MANUS
from services.acquisition.sdk_bridges.manus_gloves import ManusGloves
from services.acquisition.sdk_bridges.openvr_trackers import OpenVrTrackers, Origin
from services.acquisition.sdk_bridges.openxr_hands import LIBRARY as OPENXR
from services.acquisition.sdk_bridges.openxr_hands import OpenXrHands
from services.acquisition.sdk_bridges.parser import bridge_parser
from services.acquisition.sdk_bridges.server import run_bridge
from services.acquisition.sdk_bridges.source import Source


def build_source(options: argparse.Namespace) -> Source:
    """The source that a command line names.

    Raises:
        InvalidInputError: no device or outlet is named, or a device twice.
    """
    name = options.source
    if name in {"openvr", "libsurvive"}:
        devices = _placed(options.devices)
        if not devices and not options.list:
            raise InvalidInputError(
                "no device is named: give --device SERIAL=PLACE, such as --device "
                "LHR-1A2B3C4D=left; --list shows those present"
            )
        if name == "openvr":
            (origin,) = (origin for origin in get_args(Origin) if origin == options.origin)
            return OpenVrTrackers(devices, origin=origin)
        return LibsurviveTrackers(
            devices, library=options.library or LIBSURVIVE, arguments=options.arguments
        )
    if name == "lsl":
        if options.stream is None and not options.list:
            raise InvalidInputError("no outlet is named: give --stream; --list shows those present")
        return LslStream(options.stream or "", by=options.by)
    sides = tuple(side for side in SIDES if side in (options.sides or SIDES))
    if name == "manus":
        return ManusGloves(sides, library=options.library or MANUS)
    return OpenXrHands(sides, library=options.library or OPENXR)


def _placed(devices: Sequence[tuple[str, str]]) -> dict[str, str]:
    """Places of devices by their serial numbers."""
    serials = [serial for serial, _ in devices]
    # Any number of devices may have no place.
    places = [place for _, place in devices if place != "none"]
    for what, names in (("device", serials), ("place", places)):
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise InvalidInputError(
                f"--device: got the {what} {', '.join(repeated)} more than once, expected each "
                "once; give every device its own place, or `none`"
            )
    return dict(devices)


def main(arguments: Sequence[str]) -> int:
    """Run `dextouch station bridge`."""
    options = bridge_parser().parse_args(arguments)
    source = build_source(options)
    if getattr(options, "list", False):
        found = source.present()
        for line in found or ["nothing found"]:
            _say(line)
        write_result(options.json, found)
        return 0
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    address = options.path or (options.host, options.port)
    summary = run_bridge(source, address, stop=stop, say=_say)
    for line in (*summary.lines(), *source.report()):
        _say(line)
    write_result(options.json, summary.as_json())
    return 0


def _say(text: str) -> None:
    print(printable(text), flush=True)
