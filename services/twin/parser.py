"""Command line of `dextouch twin`; importing it starts no simulation."""

import argparse

from dextouch.command_line import CommandParser, add_json, add_workers
from dextouch.data_folder import default_store
from services.twin import names

EXAMPLE = "example:\n  dextouch twin record --task stand_bottle --seeds 0:8 --store data/store"


def twin_parser() -> argparse.ArgumentParser:
    """Parser of `dextouch twin`."""
    parser = CommandParser(
        prog="dextouch twin",
        description="Record ground-truth episodes in the physics twin, or serve rollouts in it.",
        epilog="example:\n  dextouch twin serve --port 8084",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="{record,serve}")
    _add_record(commands)
    commands.add_parser("serve", help="serve rollouts in the twin; flags: serve --help")
    return parser


def _add_record(commands: "argparse._SubParsersAction[CommandParser]") -> None:
    does = "record ground-truth episodes of a scripted demonstrator"
    make = commands.add_parser("record", help=does, description=does.capitalize(), epilog=EXAMPLE)
    add = make.add_argument
    add("--task", required=True, choices=names.TASK_NAMES, help="task to demonstrate")
    add("--seeds", required=True, type=_seed_range, metavar="A:B", help="seeds A … B-1")
    add("--domain", default="robot", choices=names.DOMAINS, help="hands (%(default)s)")
    error = "standard deviation of the demonstrator's error (m)"
    add("--noise", default=0.0, type=float, metavar="M", help=error)
    misses = "share of takes whose objects are elsewhere (%(default)s)"
    add("--miss-fraction", default=0.0, type=float, metavar="SHARE", help=misses)
    freeze = "freeze commands from a step on (0 … 80)"
    add("--freeze-from", type=int, metavar="STEP", help=freeze)
    add("--motion", choices=names.MOTION_KINDS, help="replace the script by this motion")
    first = "first step of --motion (%(default)s)"
    add("--motion-from", type=int, default=0, metavar="STEP", help=first)
    other = "play the actions of another seed instead"
    add("--actions-of", type=int, metavar="SEED", help=other)
    kinds = "change the script's commands, strength 0 … 1; repeat for more: "
    kinds += ", ".join(names.MISTAKE_KINDS)
    add("--mistake", action="append", default=[], metavar="KIND=STRENGTH", help=kinds)
    add("--varied", action="store_true", help="vary colours, light and head camera by seed")
    for name, axes in (("width", "x and y"), ("height", "z")):
        factor = f"of objects that hands can carry, along {axes} of their frames (%(default)s)"
        add(f"--{name}", type=float, default=1.0, metavar="FACTOR", help=factor)
    add("--cameras", nargs="*", default=list(names.CAMERAS), choices=names.CAMERAS, help="(all)")
    every = "record images of every n-th step instead of at 30 Hz"
    add("--image-every", type=int, metavar="N", help=every)
    streams = "streams to record (%(default)s)"
    add("--streams", default="all", choices=names.STREAM_CHOICES, help=streams)
    store = "store for the episodes (%(default)s)"
    add("--store", default=default_store(), help=store, metavar="URL")
    add_workers(make, default=1)
    add_json(make)


def _seed_range(text: str) -> range:
    first, separator, last = text.partition(":")
    if not (first.isdecimal() and (last.isdecimal() or not separator)):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected A:B or A with 0 ≤ A < B")
    seeds = range(int(first), int(last) if separator else int(first) + 1)
    if not seeds:
        raise argparse.ArgumentTypeError(f"got the empty range {text!r}, expected A < B")
    return seeds
