"""Command `dextouch station calibrate`: cameras, mounts, gloves, wrists, robot bases, latencies."""

import argparse
import importlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dextouch.command_line import CommandParser, add_json, write_result
from dextouch.data_folder import default_spool
from services.alignment.station_calibration.boards import BOARD_HELP

EXIT_LEVEL = 1

_ABOUT = """\
Calibrate the devices of a station. All results are written to one folder:
  calibration.json           matrices, as stored in recordings; start the station with
                             DEXTOUCH_ACQUISITION_CALIBRATION=FOLDER/calibration.json
  calibration_details.json   sigma, time, software, inputs
  pictures/                  plots of coverage and residuals

A complete calibration:
  1. glove     at a running station, which records rest and known pressures step by step
               dextouch station calibrate glove --side left --url http://127.0.0.1:8083 \\
                 --to calibration
  2. camera    25 photos of a printed board, everywhere in the image, near and far, tilted
               dextouch station calibrate camera --camera head --photos photos/head \\
                 --board charuco:5x7:30mm:22mm --to calibration
  3. hand-eye  20 photos of a fixed board with the tracker's pose at each, rotated about all axes
               dextouch station calibrate hand-eye --camera head --photos photos/mount \\
                 --poses photos/mount/poses.csv --board charuco:5x7:30mm:22mm --to calibration
  4. show      age and sigma of everything; warns after seven days
               dextouch station calibrate show calibration

If required:
  wrist        gloves whose keypoints are not in wrist axes: a take of the flat hand
  profile      once per person: a take in which the hand opens, closes and spreads
  robot-base   robots that report poses in their base frame: pose pairs of tracker and effector
  time         path delays of trackers and cameras: a take in which all are shaken together
  latency      a glove, or its tracker, with unknown path delay: a take of taps

More: docs/calibration_guide.md"""

_CAMERA = """\
Good photos: 25 of them, with the board in every ninth of the image including the corners, near and
far, tilted towards each of its edges by 20 to 45 degrees, static and sharp. The residual is not a
measure of accuracy (it is as small for 8 photos as for 40): check the sigma (±).

  --photos FOLDER            calibrate with the photos of a folder
  --photos FOLDER --watch    watch for new photos, report what is missing, then calibrate
  --photos FOLDER --url URL  take still views from a running station into the folder, likewise
  --check                    only report the coverage of the photos and advice

example:
  dextouch station calibrate camera --camera head --photos photos/head \\
    --board charuco:5x7:30mm:22mm --to calibration"""

_HAND_EYE = """\
The board is fixed; hold the tracker with its camera still at every photo. Rotate it by 30 degrees
or more about at least two of its axes, better three. The camera must be calibrated first
(--intrinsics: its folder, if it is not --to). With poses of the board in the file no photos are
needed. If poses are refused as inverted, --invert inverts that side.

example:
  dextouch station calibrate hand-eye --camera head --photos photos/mount \\
    --poses photos/mount/poses.csv --board charuco:5x7:30mm:22mm --to calibration"""

_GLOVE = """\
  --url URL                  a running station records all takes: this command guides you (rest,
                             then each pressure), checks every take and repeats invalid ones. The
                             takes are read from the station's --spool; on another machine give
                             --store URL, and they are read after their upload
  --rest TAKE --presses CSV  existing takes: folders of a spool, or ids with --store URL

The list of presses is a CSV: take and pressure_kpa, or mass_kg and area_cm2 of a weight; optional
columns are sigma_kpa, pads (thumb+index, palm, all), start_s, stop_s (seconds in the take).
  take,pressure_kpa,sigma_kpa,pads
  spool/bladder-10,10,0.1,all
  spool/bladder-30,30,0.3,all
Without presses only the tare is measured, for example daily; the gain is kept.

example:
  dextouch station calibrate glove --side left --url http://127.0.0.1:8083 --to calibration"""

_WRIST = """\
Record one second or more of the flat hand, fingers straight; once for each person and glove.

example:
  dextouch station calibrate wrist --side left --take spool/flat-left --to calibration"""

_PROFILE = """\
Record ten seconds in which the hand opens, closes and spreads its fingers. Without a profile every
recording's own motion is used, which is less accurate.

example:
  dextouch station calibrate profile --side left --take spool/fist-left --to calibration"""

_ROBOT_BASE = """\
Fix a tracker to the robot's effector and stop at 20 poses all over the workspace, rotated by 30
degrees or more about all axes. The file holds a pair of 4x4 matrices for each:
  [[T_world_tracker, T_base_effector], ...]
The mount of the tracker on the effector is estimated too, unless --same-frame states that both
series are poses of the same frame.

example:
  dextouch station calibrate robot-base --poses pairs.json --to calibration"""

_SHOW = """\
example:
  dextouch station calibrate show calibration"""

_LATENCY = """\
Of a glove against its tracker: tap a hard table with the flat hand, ten times, half a second and
more apart. The result is relative to the latency that the reference has. For trackers and cameras
use `time`, which measures all at once.

example:
  dextouch station calibrate latency --stream wrist_left --reference tactile_left \\
    --take spool/taps --to calibration"""

_TIME = """\
Hold or strap trackers and cameras together rigidly, and turn them briskly and irregularly about all
axes for ten seconds, cameras towards a room with edges (not a bare wall) and in good light.
Trackers may be of several systems, whose worlds differ. Each camera needs its K (of --to or of the
take). Gloves whose keypoints are in wrist axes do not show how the hand turns: use `latency` with
taps.

Delays are relative to --reference; by default to the stream whose latency is known best.

example:
  dextouch station calibrate time --take spool/shake --to calibration"""

# What each command measures, its longer help, and `module:function` that runs it.
_COMMANDS = {
    "camera": (
        "photos of a board → K and distortion of a camera",
        _CAMERA,
        "pipelines.calibrate.commands:calibrate",
    ),
    "hand-eye": (
        "photos and poses → camera on its tracker",
        _HAND_EYE,
        "alignment.station_calibration.mount:calibrate_mount",
    ),
    "glove": (
        "rest and known pressures → tare, gain, faults",
        _GLOVE,
        "alignment.station_calibration.glove:calibrate",
    ),
    "wrist": (
        "flat hand → wrist axes of a glove's keypoints",
        _WRIST,
        "pipelines.calibrate.commands:measure_wrist",
    ),
    "profile": (
        "moving hand → the person's bones and knuckles",
        _PROFILE,
        "pipelines.calibrate.commands:measure_person",
    ),
    "robot-base": (
        "pairs of poses → the robot's base in the world",
        _ROBOT_BASE,
        "pipelines.calibrate.commands:calibrate_base",
    ),
    "time": (
        "shaking everything together → all path delays",
        _TIME,
        "alignment.station_calibration.times:measure_times",
    ),
    "latency": (
        "taps of a hand → path delay of glove or tracker",
        _LATENCY,
        "pipelines.calibrate.commands:measure_latency",
    ),
    "show": ("contents, age and accuracy of a calibration", _SHOW, "pipelines.calibrate.show:show"),
}


def main(argv: Sequence[str]) -> int:
    """Run one calibration, or show the existing ones.

    Returns 0; for `show` 1 if something is missing or wrong (level ERROR).
    """
    options = _parser().parse_args(list(argv))
    module, _, function = _COMMANDS[options.word][2].partition(":")
    run = getattr(importlib.import_module(f"services.{module}"), function)
    report: dict[str, object] = run(options)
    write_result(options.json, report, allow_nan=False)
    return EXIT_LEVEL if report.get("level") == "ERROR" else 0


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(prog="dextouch station calibrate", description=_ABOUT)
    words = parser.add_subparsers(dest="word", required=True, metavar="WORD")
    of = {
        name: words.add_parser(name, help=does, description=does, epilog=more)
        for name, (does, more, _) in _COMMANDS.items()
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
