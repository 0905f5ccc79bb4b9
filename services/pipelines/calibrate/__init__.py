"""Command `dextouch station calibrate`: cameras, mounts, gloves, wrists, robot bases, latencies."""

import argparse
import importlib
import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dextouch.command_line import CommandParser, add_json, write_result
from dextouch.data_folder import default_spool
from services.alignment.station_calibration.boards import BOARD_HELP

EXIT_LEVEL = 1

# What each command measures (`does`), its longer help, and `module:function` that runs it.
_WORDS = tomllib.loads(Path(__file__).with_name("commands.toml").read_text(encoding="utf-8"))


def main(argv: Sequence[str]) -> int:
    """Run one calibration, or show the existing ones.

    Returns 0; for `show` 1 if something is missing or wrong (level ERROR).
    """
    options = _parser().parse_args(list(argv))
    module, _, function = _WORDS["commands"][options.word]["runs"].partition(":")
    run = getattr(importlib.import_module(f"services.{module}"), function)
    report: dict[str, object] = run(options)
    write_result(options.json, report, allow_nan=False)
    return EXIT_LEVEL if report.get("level") == "ERROR" else 0


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(prog="dextouch station calibrate", description=_WORDS["about"])
    words = parser.add_subparsers(dest="word", required=True, metavar="WORD")
    of = {
        name: words.add_parser(name, help=one["does"], description=one["does"], epilog=one["more"])
        for name, one in _WORDS["commands"].items()
    }

    def add(names: str, flag: str, **how: Any) -> None:  # noqa: ANN401 - argparse's own
        for name in names.split():
            of[name].add_argument(flag, **how)

    for command in of.values():
        add_json(command)
    measuring = " ".join(name for name in of if name != "show")
    folder = {"type": Path, "metavar": "FOLDER"}
    add(measuring, "--to", required=True, help="calibration folder; created if new", **folder)
    source = "calibration folder or file, or a spooled take"
    add("show", "folder", type=Path, metavar="PATH", help=source)
    add("glove wrist profile", "--side", required=True, choices=("left", "right"), help="hand")
    take = "spool folder, or id of a recording"
    add("wrist profile time latency", "--take", required=True, metavar="TAKE", help=take)
    store = "store of recordings given by id"
    add("glove wrist profile time latency", "--store", metavar="URL", help=store)
    some = "streams to calibrate (default: all that show how they turn)"
    add("time", "--streams", metavar="A,B", help=some)
    add("time", "--reference", metavar="STREAM", help="stream that the others are relative to")
    _add_cameras(add, folder)
    _add_glove(add, folder)
    add("robot-base", "--poses", type=Path, required=True, metavar="FILE", help="JSON of pairs")
    same = "tracker and effector are the same frame"
    add("robot-base", "--same-frame", action="store_true", help=same)
    for flag, what in (
        ("--stream", "stream to calibrate"),
        ("--reference", "stream of known latency, or of latency 0 by definition"),
    ):
        add("latency", flag, required=True, metavar="STREAM", help=what)
    return parser


def _add_cameras(add: Callable[..., None], folder: Mapping[str, Any]) -> None:
    cameras = {"required": True, "choices": ("head", "wrist_left", "wrist_right")}
    add("camera hand-eye", "--camera", help="camera to calibrate", **cameras)
    add("camera hand-eye", "--check", action="store_true", help="only report what is missing")
    add("camera", "--photos", required=True, help="folder of photos", **folder)
    add("hand-eye", "--photos", help="photos that FILE names", **folder)
    add("camera", "--board", required=True, metavar="BOARD", help=BOARD_HELP)
    add("hand-eye", "--board", metavar="BOARD", help=BOARD_HELP)
    add("camera", "--watch", action="store_true", help="watch the folder for new photos")
    add("camera", "--url", metavar="URL", help="take photos from this running station")
    add("camera glove", "--key", metavar="KEY", help="API key of the station")
    add("hand-eye", "--poses", type=Path, required=True, metavar="FILE", help="CSV or JSON")
    add("hand-eye", "--intrinsics", help="calibration with K (default: --to)", **folder)
    add("hand-eye", "--invert", choices=("tracker", "board"), help="invert these poses")


def _add_glove(add: Callable[..., None], folder: Mapping[str, Any]) -> None:
    add("glove", "--url", metavar="URL", help="running station that records the takes")
    spool = "spool of the station, with --url (%(default)s)"
    add("glove", "--spool", default=default_spool(), help=spool, **folder)
    add("glove", "--rest", metavar="TAKE", help="take of 10 s without contact")
    add("glove", "--presses", type=Path, metavar="CSV", help="list of takes under pressure")
    ratio = "relative sigma of pressures without sigma_kpa (%(default)s)"
    add("glove", "--pressure-sigma", type=float, default=0.02, metavar="RATIO", help=ratio)
    counts = "largest count of the glove (%(default)g)"
    add("glove", "--full-scale", type=float, default=65535.0, metavar="COUNTS", help=counts)
