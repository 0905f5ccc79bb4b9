"""Command `dextouch station bridge`: serves the samples of an SDK to stations until Ctrl-C."""

import argparse
import signal
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from dextouch.command_line import CommandParser, add_json, write_result
from dextouch.errors import InvalidInputError
from dextouch.free_text import printable

# The help is shown without SDKs and drivers.
if TYPE_CHECKING:
    from services.acquisition.sdk_bridges.bridge import Source

# Chosen: five ports in a row that no other service of ours uses.
PORTS: Final = {"openvr": 9110, "libsurvive": 9111, "manus": 9112, "openxr": 9113, "lsl": 9114}
SUMMARIES: Final = {
    "openvr": "poses of Vive trackers, controllers and headsets from SteamVR",
    "libsurvive": "poses of lighthouse trackers without SteamVR",
    "manus": "finger keypoints of MANUS gloves on this computer",
    "openxr": "finger keypoints of an OpenXR runtime with hand tracking",
    "lsl": "numbers of a Lab Streaming Layer outlet",
}
PLACES: Final = ("left", "right", "head", "none")
# TCP has 16 bits for it.
MAX_PORT: Final = 65_535

_NEEDS: Final = {
    "openvr": """\
Needs SteamVR, running, and the Python module openvr (extra `bridges`).
A device is named by its serial number, such as LHR-1A2B3C4D: it is printed on it, and
--list shows those that SteamVR knows. Switched off devices may be named, too.""",
    "libsurvive": """\
Needs the shared library of libsurvive (github.com/cntools/libsurvive) and its udev rules,
and that no other program uses the dongles. A device is named by its serial number
(LHR-1A2B3C4D) or by libsurvive's name (T20, T21, WM0, HMD); --list shows both.""",
    "manus": """\
Needs the integrated library of the MANUS Core SDK 2.4 or 3.x (docs.manus-meta.com), a licence
for it on the dongle, and its udev rules. Gloves are distinguished by their hand; the axes of
their wrist are calibrated with `dextouch station calibrate wrist`.""",
    "openxr": """\
Needs the OpenXR loader (Debian: libopenxr-loader1) and an active runtime with the extensions
XR_EXT_hand_tracking, XR_MND_headless and XR_KHR_convert_timespec_time, such as Monado. Hands
are distinguished by the runtime.""",
    "lsl": """\
Needs the Python module pylsl (extra `bridges`), which brings liblsl. The
outlet is named by its name, type or source_id; --list shows those of the network. The
station's settings declare what the numbers are: kind, shape, unit and rate.""",
}
_SETTINGS: Final = {
    "openvr": '{"kind": "pose_tracker", "stream": "wrist_left", "link": "bridge", "port": 9110,\n'
    '   "serial_number": "LHR-1A2B3C4D"}',
    "libsurvive": '{"kind": "pose_tracker", "stream": "wrist_left", "link": "bridge", '
    '"port": 9111,\n   "serial_number": "LHR-1A2B3C4D"}',
    "manus": '{"kind": "finger_tracker", "side": "left", "link": "bridge", "port": 9112}',
    "openxr": '{"kind": "finger_tracker", "side": "left", "link": "bridge", "port": 9113}',
    "lsl": '{"kind": "numbers", "stream": "emg_left", "port": 9114, "shape": [8], "unit": "uV",\n'
    '   "rate_hz": 1000}',
}
_EXAMPLES: Final = {
    "openvr": ("--device LHR-1A2B3C4D=left --device LHR-5E6F7A8B=right", "--list"),
    "libsurvive": ("--device LHR-1A2B3C4D=left --device T20=head", "--list"),
    "manus": ("--library /opt/manus/libManusSDK_Integrated.so", "--side left"),
    "openxr": ("", "--side left --path /run/dextouch/openxr"),
    "lsl": ("--stream EMG", "--stream myuid323457 --by source_id", "--list"),
}


def named_place(text: str) -> tuple[str, str]:
    """Parse `SERIAL=PLACE`, for argparse."""
    serial, found, place = text.rpartition("=")
    if not found or not serial or place not in PLACES:
        raise argparse.ArgumentTypeError(
            f"got {text!r}, expected SERIAL=PLACE with a place of {', '.join(PLACES)}"
        )
    return serial, place


def port_number(text: str) -> int:
    """Parse a TCP port, 0 … 65535, for argparse."""
    if not text.isdecimal() or not 0 <= int(text) <= MAX_PORT:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a port of 0 … {MAX_PORT}")
    return int(text)


def bridge_parser() -> argparse.ArgumentParser:
    """Parser of `dextouch station bridge`."""
    parser = CommandParser(
        prog="dextouch station bridge",
        description="Serve the samples of another program's or maker's tracker to stations, until "
        "Ctrl-C, and print how many were sent and lost. It waits for the source and connects again "
        "when it was lost.",
        epilog="example:\n  dextouch station bridge openvr --device LHR-1A2B3C4D=left",
    )
    commands = parser.add_subparsers(dest="source", required=True, metavar="SOURCE")
    for source in PORTS:
        _add_source(commands, source)
    return parser


def _add_source(commands: "argparse._SubParsersAction[CommandParser]", source: str) -> None:
    examples = "\n".join(
        f"  dextouch station bridge {source} {rest}".rstrip() for rest in _EXAMPLES[source]
    )
    parser = commands.add_parser(
        source,
        help=SUMMARIES[source],
        description=f"Serve {SUMMARIES[source]} to stations.\n\n" + _NEEDS[source],
        epilog=f"examples:\n{examples}\n\nin the station's settings:\n  {_SETTINGS[source]}\n\n"
        "frames, units and clocks: docs/sdk_bridges.md",
    )
    _add_choices(parser, source)
    address = parser.add_mutually_exclusive_group()
    address.add_argument(
        "--port",
        type=port_number,
        default=PORTS[source],
        metavar="PORT",
        help=f"where stations connect; 0: any free one (default: {PORTS[source]})",
    )
    address.add_argument(
        "--path", type=Path, metavar="PATH", help="of a local socket, instead of a port"
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="of this computer on which to listen; anyone who reaches it gets the samples "
        "(default: 127.0.0.1)",
    )
    add_json(parser)


def _add_choices(parser: argparse.ArgumentParser, source: str) -> None:
    """Options of one source: what it serves, and where its library is."""
    if source in {"openvr", "libsurvive"}:
        parser.add_argument(
            "--device",
            dest="devices",
            type=named_place,
            action="append",
            default=[],
            metavar="SERIAL=PLACE",
            help="a device and where it sits: left or right (wrist), head, or none; repeat it",
        )
    if source == "openvr":
        parser.add_argument(
            "--origin",
            choices=("standing", "raw"),
            default="standing",
            help="world frame: the play area of SteamVR's room setup, or the driver's own, which "
            "no setup changes (default: standing)",
        )
    if source == "libsurvive":
        parser.add_argument(
            "--argument",
            dest="arguments",
            action="append",
            default=[],
            metavar="FLAG",
            help="for libsurvive, such as --argument=--lighthouse-gen=2; repeat it",
        )
    if source in {"manus", "openxr"}:
        parser.add_argument(
            "--side",
            dest="sides",
            choices=("left", "right"),
            action="append",
            help="a hand to serve; repeat it (default: both)",
        )
    if source in {"libsurvive", "manus", "openxr"}:
        parser.add_argument(
            "--library", metavar="PATH", help="its shared library (default: the system's)"
        )
    if source == "lsl":
        parser.add_argument("--stream", metavar="TEXT", help="name of the outlet")
        parser.add_argument(
            "--by",
            choices=("name", "type", "source_id"),
            default="name",
            help="what --stream is (default: name)",
        )
    if source in {"openvr", "libsurvive", "lsl"}:
        parser.add_argument("--list", action="store_true", help="print what is there, and end")


def build_source(options: argparse.Namespace) -> "Source":
    """The source that a command line names.

    Raises:
        InvalidInputError: no device or outlet is named, or a device twice.
    """
    from dextouch.tactile.layout import SIDES
    from services.acquisition.sdk_bridges import lighthouse_trackers as lighthouse
    from services.acquisition.sdk_bridges import lsl_stream, manus_gloves, openxr_hands

    name = options.source
    if name in {"openvr", "libsurvive"}:
        devices = _placed(options.devices)
        if not devices and not options.list:
            raise InvalidInputError(
                "no device is named: give --device SERIAL=PLACE, such as --device "
                "LHR-1A2B3C4D=left; --list shows those present"
            )
        if name == "openvr":
            return lighthouse.OpenVrTrackers(devices, origin=options.origin)
        return lighthouse.LibsurviveTrackers(
            devices, library=options.library or lighthouse.LIBSURVIVE, arguments=options.arguments
        )
    if name == "lsl":
        if options.stream is None and not options.list:
            raise InvalidInputError("no outlet is named: give --stream; --list shows those present")
        return lsl_stream.LslStream(options.stream or "", by=options.by)
    sides = tuple(side for side in SIDES if side in (options.sides or SIDES))
    if name == "manus":
        return manus_gloves.ManusGloves(sides, library=options.library or manus_gloves.LIBRARY)
    return openxr_hands.OpenXrHands(sides, library=options.library or openxr_hands.LIBRARY)


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
    from services.acquisition.sdk_bridges.bridge import run_bridge

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
