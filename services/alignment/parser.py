"""Command line of `dextouch align`; importing it aligns nothing."""

import argparse
from pathlib import Path

from dextouch.command_line import RAY_HELP, CommandParser, add_json, positive
from dextouch.serving import load_settings
from services.alignment.settings import AlignmentSettings, usable_cores

EPILOG = """examples:
  dextouch align run take-7 take-8           align two recordings in parallel
  dextouch align run --all --workers 2       align all recordings without an episode
  dextouch align run --all --ray auto        the same on the machines of a Ray cluster
  dextouch align run --all --objects objects.json
                                             with the poses of objects that have markers
  dextouch align report take-7               clock fits, retargeting errors, omitted parts
  dextouch align retarget take-7 --model hand.urdf --mapping hand.toml --to joints.npz
                                             joint angles of another robot hand
  dextouch align serve --port 8082           run the HTTP service

An episode's id is derived from the recording and the options: aligning again finds it and writes
nothing, so an interrupted run can simply be started again."""


def align_parser(settings: AlignmentSettings) -> argparse.ArgumentParser:
    """Parser of `dextouch align`, whose default store is that of the settings."""
    parser = CommandParser(
        prog="dextouch align",
        description="Convert recordings to synchronized, retargeted episodes in the same store.",
        epilog=EPILOG,
    )
    shared = CommandParser(add_help=False)
    shared.add_argument(
        "--store", default=settings.store_url, metavar="URL", help="the store (%(default)s)"
    )
    shared.add_argument(
        "--objects",
        type=Path,
        metavar="FILE",
        help="JSON file of the tasks' objects, whose poses are measured by markers or trackers",
    )
    add_json(shared)
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="{run,report,retarget,markers,serve}"
    )
    running = commands.add_parser(
        "run",
        parents=[shared],
        help="align recordings",
        description="Align recordings; those that have an episode are left as they are.",
        epilog=EPILOG,
    )
    running.add_argument("recordings", nargs="*", metavar="ID", help="of a recording")
    running.add_argument("--all", action="store_true", help="all recordings without an episode")
    running.add_argument("--ray", metavar="ADDRESS", help=RAY_HELP)
    running.add_argument(
        "--workers",
        type=positive,
        default=usable_cores(),
        metavar="N",
        help="recordings at once, each in a process of its own (default: one a processor)",
    )
    report = commands.add_parser(
        "report",
        parents=[shared],
        help="report on an aligned recording",
        description="Show clocks, retargeting and what was left out of an episode, and why.",
        epilog="example:\n  dextouch align report take-7 --json report.json",
    )
    report.add_argument("id", metavar="ID", help="of a recording or of its episode")
    other = commands.add_parser(
        "retarget",
        parents=[shared],
        help="retarget a recording to another robot hand",
        description="Joint angles of any robot hand that follow the tracked hand of an episode, "
        "written as NPZ: joint_names, t_ref_ns, joints_rad, status, tip_error_m.",
        epilog="example:\n  dextouch align retarget take-7 --model allegro_right.urdf \\\n"
        "    --mapping allegro_right.toml --to take-7_allegro.npz\n\n"
        "The mapping is described in docs/hands.md.",
    )
    other.add_argument("id", metavar="ID", help="of an episode, or of its recording")
    other.add_argument("--model", type=Path, required=True, metavar="FILE", help="URDF or MJCF")
    other.add_argument(
        "--mapping", type=Path, required=True, metavar="FILE", help="TOML: fingers, joints, wrist"
    )
    other.add_argument("--to", type=Path, required=True, metavar="FILE", help="NPZ to write")
    sheet = commands.add_parser(
        "markers",
        help="make a sheet of the objects' markers to print",
        description="Write the markers of a file of objects as SVG in true size: print it at 100 % "
        "and measure one side.",
        epilog="example:\n  dextouch align markers --objects objects.json --to markers.svg",
    )
    sheet.add_argument("--objects", type=Path, required=True, metavar="FILE", help="of the objects")
    sheet.add_argument("--to", type=Path, required=True, metavar="FILE", help="SVG to write")
    commands.add_parser("serve", help="run the HTTP service (serve --help lists its settings)")
    return parser


def default_parser() -> argparse.ArgumentParser:
    """Parser of `dextouch align` with the settings of the environment and dextouch.toml."""
    return align_parser(load_settings(AlignmentSettings, []))
