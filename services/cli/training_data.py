"""Record twin episodes for training and testing networks.

The data set covers the factors that decide success: errors of a few millimetres, misses, takes that
stop or never start, retreats, pushes, slipping grasps, wandering hands, and actions of another
scene. `--mix` selects their shares. With `--policy` every episode is a rollout of that policy in
the twin instead. Interrupted runs resume: existing episodes are kept.
"""

import argparse
import json
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from dextouch.command_line import CommandParser, add_json, write_result
from dextouch.episodes import EpisodeStore
from dextouch.errors import ConflictError, InvalidInputError, UnknownNameError
from services.cli.data_mix import MIXES, Mix, options_of
from services.cli.policy_takes import PolicyChoice, played_by
from services.evaluation.progress import Progress
from services.twin.episodes import episode_id, record, write_episode
from services.twin.hands import DOMAINS, Domain
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.take_options import STREAM_CHOICES, StreamChoice, TakeOptions
from services.twin.tasks import TASK_NAMES

CAMERAS = ("camera_head",)
DEFAULT_MIX = "evaluator"


@dataclass(frozen=True)
class Scope:
    """Tasks, domains, images and streams to record.

    Images are recorded at the grid steps (15 Hz) that are multiples of `image_every`, and at the
    last three.
    """

    tasks: tuple[str, ...] = TASK_NAMES
    domains: tuple[Domain, ...] = ("robot",)
    image_every: int = 1
    streams: StreamChoice = "training"

    def __post_init__(self) -> None:
        for task in self.tasks:
            if task not in TASK_NAMES:
                raise UnknownNameError("task", task, list(TASK_NAMES))
        for domain in self.domains:
            if domain not in DOMAINS:
                raise UnknownNameError("domain", domain, list(DOMAINS))


@dataclass(frozen=True)
class Order:
    """One episode to record, in any process."""

    task: str
    domain: Domain
    seed: int
    options: TakeOptions
    store: str
    policy: PolicyChoice | None = None

    @property
    def episode_id(self) -> str:
        """Id of the episode, known before it is recorded."""
        played = None if self.policy is None else self.policy.label
        return episode_id(self.task, self.domain, self.seed, self.options, played=played)


@dataclass(frozen=True)
class Answer:
    """Result of an order: success, None if another process was faster, or a refusal."""

    episode_id: str
    success: bool | None = None
    refusal: str | None = None


@lru_cache(maxsize=12)
def _stage(task: str, domain: Domain) -> Stage:
    """Stage of a task, compiled once per process."""
    return Stage(task, domain, TwinSettings())


def _make(order: Order) -> Answer:
    stage = _stage(order.task, order.domain)
    try:
        if order.policy is None:
            episode = record(stage, order.seed, order.options)
        else:
            played = played_by(order.policy, stage, order.seed)
            episode = record(stage, order.seed, order.options, played=played)
        write_episode(EpisodeStore(order.store), episode)
    except ConflictError:
        return Answer(order.episode_id)
    except InvalidInputError as error:
        return Answer(order.episode_id, refusal=error.message)
    return Answer(order.episode_id, bool(episode.attributes.success))


def make_training_data(
    store: str,
    seeds: range,
    mix: Mix,
    *,
    num_jobs: int | None = None,
    scope: Scope | None = None,
    policy: PolicyChoice | None = None,
) -> dict[str, int]:
    """Record one episode per seed, task and domain; existing episodes are kept.

    Args:
        store: folder of the store.
        seeds: seeds of the scenes.
        mix: kinds of takes.
        num_jobs: processes; default: one per core.
        scope: tasks, domains and streams.
        policy: policy that acts instead of the scripts; `mix` is then ignored.

    Returns:
        Numbers of episodes `made`, `kept` and `refused` (the physics diverged, or the policy
        failed), and of those made, how many `succeeded`.

    Raises:
        InvalidInputError: no seeds, tasks or domains, or a policy with human hands.
    """
    scope = scope or Scope()
    if not seeds or not scope.tasks or not scope.domains or (num_jobs is not None and num_jobs < 1):
        raise InvalidInputError(
            f"training data: got seeds {seeds}, tasks {scope.tasks}, domains {scope.domains} and "
            f"{num_jobs} jobs, expected at least one of each"
        )
    if policy is not None and scope.domains != ("robot",):
        raise InvalidInputError("training data: got a policy for human hands; it moves the robot's")
    target = EpisodeStore(store)
    # Remove partial episodes of killed runs; those of running writers are not touched.
    target.sweep()
    present = set(target.list())
    orders = list(_orders(store, seeds, mix, scope, policy))
    missing = [order for order in orders if order.episode_id not in present]
    counts = {"made": 0, "kept": len(orders) - len(missing), "succeeded": 0, "refused": 0}
    started_s = time.monotonic()
    with Progress("twin episodes", len(missing)) as progress:
        for done, answer in enumerate(
            record_all(missing, num_jobs or os.cpu_count() or 1), start=1
        ):
            if answer.refusal is not None:
                counts["refused"] += 1
                print(f"{answer.episode_id}: {answer.refusal}")
            elif answer.success is None:
                counts["kept"] += 1
            else:
                counts["made"] += 1
                counts["succeeded"] += answer.success
            each_s = (time.monotonic() - started_s) / done
            progress.advance(
                episodes_per_s=1 / each_s, minutes_left=each_s * (len(missing) - done) / 60
            )
    return counts


def _orders(
    store: str, seeds: range, mix: Mix, scope: Scope, policy: PolicyChoice | None
) -> Iterator[Order]:
    for seed in seeds:
        for task in scope.tasks:
            made = TakeOptions() if policy is not None else options_of(task, seed, mix)
            options = replace(
                made, images=CAMERAS, image_every=scope.image_every, streams=scope.streams
            )
            for domain in scope.domains:
                yield Order(task, domain, seed, options, store, policy)


def record_all(orders: Sequence[Order], num_jobs: int) -> Iterator[Answer]:
    """Record episodes in processes of their own; yields their results as they are done."""
    if num_jobs == 1 or len(orders) < 2:
        yield from map(_make, orders)
        return
    with ExitStack() as stack:
        # Spawned, not forked: threads and locks of the caller must not be copied half-way.
        pool = stack.enter_context(
            ProcessPoolExecutor(min(num_jobs, len(orders)), multiprocessing.get_context("spawn"))
        )
        # If the caller stops, pending orders are cancelled.
        stack.callback(pool.shutdown, wait=False, cancel_futures=True)
        for future in as_completed([pool.submit(_make, order) for order in orders]):
            yield future.result()


def _words(choices: Sequence[str]) -> Callable[[str], tuple[str, ...]]:
    """Parser of comma-separated names."""

    def read(text: str) -> tuple[str, ...]:
        names = tuple(name for name in text.split(",") if name)
        wrong = [name for name in names if name not in choices]
        if wrong or not names:
            raise argparse.ArgumentTypeError(f"got {text!r}, expected some of {','.join(choices)}")
        return names

    return read


def _keywords(text: str) -> dict[str, Any]:
    try:
        read = json.loads(text)
    except json.JSONDecodeError as error:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a JSON object") from error
    if not isinstance(read, dict):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a JSON object")
    return read


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="dextouch train data",
        description=__doc__,
        epilog="example:\n  dextouch train data --store runs/episodes --count 20 --images 4",
    )
    parser.add_argument("--store", required=True, help="folder of the episode store")
    parser.add_argument("--first", type=int, default=0, help="first seed (%(default)s)")
    parser.add_argument("--count", type=int, default=130, help="seeds per task (%(default)s)")
    parser.add_argument(
        "--tasks",
        type=_words(TASK_NAMES),
        default=TASK_NAMES,
        help="comma-separated (default: all)",
    )
    parser.add_argument(
        "--domains", type=_words(DOMAINS), default=("robot",), help="robot,human (robot)"
    )
    mixes = parser.add_mutually_exclusive_group()
    mixes.add_argument(
        "--mix", choices=list(MIXES), default=DEFAULT_MIX, help="kinds of takes (%(default)s)"
    )
    for name, effect in (("exact", "no errors"), ("ladder", "errors of 0 … 40 mm in turn")):
        mixes.add_argument(
            f"--{name}",
            dest="mix",
            action="store_const",
            const=name,
            help=f"{effect}, no other kinds",
        )
    parser.add_argument("--miss-fraction", type=float, help="share of misses (default: the mix's)")
    parser.add_argument(
        "--still-fraction", type=float, help="share of takes that stop or never start"
    )
    parser.add_argument(
        "--policy", metavar="[NAME=]MODULE:FACTORY", help="record rollouts of this policy instead"
    )
    parser.add_argument(
        "--policy-arguments",
        type=_keywords,
        default={},
        help="arguments of the factory, as a JSON object",
    )
    parser.add_argument(
        "--images", type=int, default=1, metavar="N", help="images of every N-th step (%(default)s)"
    )
    parser.add_argument(
        "--streams", choices=STREAM_CHOICES, default="training", help="(%(default)s)"
    )
    parser.add_argument("--jobs", type=int, help="processes (default: one per core)")
    add_json(parser)
    return parser


def main(argv: Sequence[str]) -> int:
    """Run `dextouch train data`; returns 1 if an episode could not be recorded."""
    arguments = _parser().parse_args(list(argv))
    seeds = range(arguments.first, arguments.first + max(0, arguments.count))
    mix = MIXES[arguments.mix].changed(miss=arguments.miss_fraction, still=arguments.still_fraction)
    scope = Scope(arguments.tasks, arguments.domains, arguments.images, arguments.streams)
    policy = arguments.policy and PolicyChoice.parse(arguments.policy, arguments.policy_arguments)
    counts = make_training_data(
        arguments.store, seeds, mix, num_jobs=arguments.jobs, scope=scope, policy=policy
    )
    print(", ".join(f"{count} {name}" for name, count in counts.items()))
    write_result(arguments.json, counts)
    return 1 if counts["refused"] else 0
