"""Command line `dextouch twin`: record ground-truth episodes of the physics twin to a store."""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from dextouch.command_line import progress, write_result
from dextouch.episodes import EpisodeStore
from dextouch.errors import ConflictError, InvalidInputError
from dextouch.jobs import Workers, results_of, run_jobs
from services.twin.demonstrators import Motion
from services.twin.episodes import record, write_episode
from services.twin.mistakes import Mistake
from services.twin.names import Domain
from services.twin.parser import twin_parser
from services.twin.scene import Sizes
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.take_options import TakeOptions

_MISS_DRAW = 5  # stream of random numbers of its own
# Seed and options of a take, for a worker process.
Order = tuple[int, TakeOptions]


@dataclass(frozen=True)
class TakeReport:
    """Result of one take; `kept` if the same command had recorded the episode before."""

    episode_id: str
    seed: int
    success: bool
    miss: bool
    kept: bool = False


@lru_cache(maxsize=2)
def _stage(task: str, domain: Domain) -> Stage:
    return Stage(task, domain, TwinSettings())


def _take(task: str, domain: Domain, store_url: str, order: Order) -> TakeReport:
    seed, options = order
    episode = record(_stage(task, domain), seed, options)
    about, store = episode.attributes, EpisodeStore(store_url)
    kept = False
    try:
        write_episode(store, episode)
    except ConflictError:
        # Not every option is in the id.
        existing = store.open(about.episode_id).attributes
        if existing.generator_command != about.generator_command:
            raise
        kept = True
    return TakeReport(about.episode_id, seed, bool(about.success), options.miss, kept=kept)


def _orders(arguments: argparse.Namespace) -> list[Order]:
    if not 0.0 <= arguments.miss_fraction <= 1.0:
        raise InvalidInputError(
            f"twin record: got --miss-fraction {arguments.miss_fraction}, expected 0 … 1"
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
            tuple(map(Mistake.parse, arguments.mistake)),
            arguments.varied,
            Sizes(arguments.width, arguments.height),
        )
        orders.append((seed, options))
    return orders


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
        "num_kept": sum(report.kept for report in reports),
        "success_rate": sum(report.success for report in aimed) / len(aimed) if aimed else None,
        "seconds": seconds,
    }


def main(argv: Sequence[str]) -> int:
    """Run `dextouch twin record`."""
    arguments = twin_parser().parse_args(list(argv))
    start_s = time.monotonic()
    orders = _orders(arguments)
    workers = Workers(arguments.jobs, arguments.ray)
    take = partial(_take, arguments.task, arguments.domain, arguments.store)
    jobs = run_jobs(take, orders, workers, folders=EpisodeStore(arguments.store).folders)
    done = results_of(progress(jobs, "twin record", len(orders)))
    reports = sorted(done, key=lambda report: report.seed)
    summary = _summary(arguments, reports, time.monotonic() - start_s)
    write_result(arguments.json, summary)
    succeeded = sum(report.success for report in reports)
    print(
        f"{len(reports)} episodes of {arguments.task} ({arguments.domain}) in {arguments.store}: "
        f"{succeeded} succeeded, {summary['num_misses']} were misses, "
        f"{summary['num_kept']} existed already, {summary['seconds']:.1f} s"
    )
    return 0
