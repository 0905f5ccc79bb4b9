"""Command line `dextouch twin`: record ground-truth episodes of the physics twin to a store."""

import argparse
import multiprocessing
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from dextouch.command_line import CommandParser, add_json, progress, write_result
from dextouch.data_folder import default_store
from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError
from services.twin.cameras import CAMERAS
from services.twin.episodes import record, write_episode
from services.twin.hands import DOMAINS, Domain
from services.twin.mistakes import KINDS, Mistake
from services.twin.motions import MOTION_KINDS, Motion
from services.twin.settings import TwinSettings
from services.twin.sizes import Sizes
from services.twin.stage import Stage
from services.twin.take_options import STREAM_CHOICES, TakeOptions
from services.twin.tasks import TASK_NAMES

_MISS_DRAW = 5
EXAMPLE = "example:\n  dextouch twin record --task stand_bottle --seeds 0:8 --store data/store"


@dataclass(frozen=True)
class TakeOrder:
    """Order for one episode, for a worker process."""

    task: str
    domain: Domain
    seed: int
    options: TakeOptions
    store_url: str


@dataclass(frozen=True)
class TakeReport:
    """Result of one order."""

    episode_id: str
    seed: int
    success: bool
    miss: bool


@lru_cache(maxsize=2)
def _stage(task: str, domain: Domain) -> Stage:
    """Stage of a task, compiled once per process."""
    return Stage(task, domain, TwinSettings())


def _take(order: TakeOrder) -> TakeReport:
    episode = record(_stage(order.task, order.domain), order.seed, order.options)
    episode_id = write_episode(EpisodeStore(order.store_url), episode)
    return TakeReport(episode_id, order.seed, bool(episode.attributes.success), order.options.miss)


def _seed_range(text: str) -> range:
    first, separator, last = text.partition(":")
    if not (first.isdecimal() and (last.isdecimal() or not separator)):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected A:B or A with 0 ≤ A < B")
    seeds = range(int(first), int(last) if separator else int(first) + 1)
    if not seeds:
        raise argparse.ArgumentTypeError(f"got the empty range {text!r}, expected A < B")
    return seeds


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="dextouch twin",
        description="Record ground-truth episodes in the physics twin, or serve rollouts in it.",
        epilog="example:\n  dextouch twin serve --port 8084",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="{record,serve}")
    does = "record ground-truth episodes of a scripted demonstrator"
    make = commands.add_parser("record", help=does, description=does.capitalize(), epilog=EXAMPLE)
    make.add_argument("--task", required=True, choices=TASK_NAMES, help="task to demonstrate")
    make.add_argument(
        "--seeds", required=True, type=_seed_range, metavar="A:B", help="seeds A … B-1"
    )
    make.add_argument("--domain", default="robot", choices=DOMAINS, help="hands (%(default)s)")
    make.add_argument(
        "--noise",
        default=0.0,
        type=float,
        metavar="M",
        help="standard deviation of the demonstrator's error (m)",
    )
    make.add_argument(
        "--miss-fraction",
        default=0.0,
        type=float,
        metavar="SHARE",
        help="share of takes whose objects are elsewhere (%(default)s)",
    )
    make.add_argument(
        "--freeze-from", type=int, metavar="STEP", help="freeze commands from a step on (0 … 80)"
    )
    make.add_argument("--motion", choices=MOTION_KINDS, help="replace the script by this motion")
    make.add_argument(
        "--motion-from",
        type=int,
        default=0,
        metavar="STEP",
        help="first step of --motion (%(default)s)",
    )
    make.add_argument(
        "--actions-of", type=int, metavar="SEED", help="play the actions of another seed instead"
    )
    make.add_argument(
        "--mistake",
        action="append",
        type=Mistake.parse,
        default=[],
        metavar="KIND=STRENGTH",
        help=f"change the script's commands, strength 0 … 1; repeat for more: {', '.join(KINDS)}",
    )
    make.add_argument(
        "--varied", action="store_true", help="vary colours, light and head camera by seed"
    )
    for name, axes in (("width", "x and y"), ("height", "z")):
        make.add_argument(
            f"--{name}",
            type=float,
            default=1.0,
            metavar="FACTOR",
            help=f"of objects that hands can carry, along {axes} of their frames (%(default)s)",
        )
    make.add_argument("--cameras", nargs="*", default=list(CAMERAS), choices=CAMERAS, help="(all)")
    make.add_argument(
        "--image-every",
        type=int,
        metavar="N",
        help="record images of every n-th step instead of at 30 Hz",
    )
    make.add_argument(
        "--streams", default="all", choices=STREAM_CHOICES, help="streams to record (%(default)s)"
    )
    make.add_argument(
        "--store",
        default=default_store(),
        help="store for the episodes (%(default)s)",
        metavar="URL",
    )
    make.add_argument("--jobs", default=1, type=int, metavar="N", help="processes (%(default)s)")
    add_json(make)
    commands.add_parser("serve", help="serve rollouts in the twin; flags: serve --help")
    return parser


def _orders(arguments: argparse.Namespace) -> list[TakeOrder]:
    if not 0.0 <= arguments.miss_fraction <= 1.0 or arguments.jobs < 1:
        raise InvalidInputError(
            f"twin record: got --miss-fraction {arguments.miss_fraction} and --jobs "
            f"{arguments.jobs}, expected a fraction 0 … 1 and at least one job"
        )
    orders = []
    for seed in arguments.seeds:
        draw = np.random.default_rng([seed, _MISS_DRAW]).random()
        options = TakeOptions(
            arguments.noise,
            bool(draw < arguments.miss_fraction),
            tuple(arguments.cameras),
            arguments.freeze_from,
            Motion(arguments.motion, arguments.motion_from) if arguments.motion else None,
            arguments.actions_of,
            arguments.image_every,
            arguments.streams,
            tuple(arguments.mistake),
            arguments.varied,
            Sizes(arguments.width, arguments.height),
        )
        orders.append(TakeOrder(arguments.task, arguments.domain, seed, options, arguments.store))
    return orders


def _work(orders: Sequence[TakeOrder], num_jobs: int) -> Iterator[TakeReport]:
    if num_jobs == 1:
        yield from map(_take, orders)
        return
    # Spawned processes: forking would copy the caller's threads and locks.
    with multiprocessing.get_context("spawn").Pool(num_jobs) as pool:
        yield from pool.imap(_take, orders)


def _summary(
    arguments: argparse.Namespace, reports: Sequence[TakeReport], seconds: float
) -> dict[str, object]:
    aimed = [report for report in reports if not report.miss]
    return {
        "task": arguments.task,
        "domain": arguments.domain,
        "noise_m": arguments.noise,
        "episodes": [report.episode_id for report in reports],
        "num_misses": len(reports) - len(aimed),
        "success_rate": sum(report.success for report in aimed) / len(aimed) if aimed else None,
        "seconds": seconds,
    }


def main(argv: Sequence[str]) -> int:
    """Run `dextouch twin record`."""
    arguments = _parser().parse_args(list(argv))
    start_s = time.monotonic()
    orders = _orders(arguments)
    reports = list(progress(_work(orders, arguments.jobs), "twin record", len(orders)))
    summary = _summary(arguments, reports, time.monotonic() - start_s)
    write_result(arguments.json, summary)
    succeeded = sum(report.success for report in reports)
    print(
        f"{len(reports)} episodes of {arguments.task} ({arguments.domain}) in {arguments.store}: "
        f"{succeeded} succeeded, {summary['num_misses']} were misses, {summary['seconds']:.1f} s"
    )
    return 0
