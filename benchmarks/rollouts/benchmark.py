"""Entry point of the benchmark stage `rollouts`: time of a chunk compared with an echo."""

import argparse
import statistics
import time
from collections import defaultdict
from collections.abc import Mapping
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Final

from benchmarks.figures import Figure, Requirement, at_least, at_most, interleaved
from benchmarks.report import ResultTable, StageReport
from benchmarks.rollouts.watcher import listing_s, watched
from benchmarks.rollouts.ways import (
    MAX_CHUNKS,
    MAX_STEPS,
    Chunk,
    Crowd,
    StillWorld,
    Way,
    compared,
    crowd,
    opened,
    processor_s,
    resting_actions,
)
from benchmarks.stages import Amounts, Bar
from dextouch.errors import InvalidInputError
from dextouch.schemas import ReturnSelector
from dextouch.serving import ChildProcess

LAST: Final = ReturnSelector(steps="last")
JPEG: Final = ReturnSelector(steps="last", images="jpeg")
ALL: Final = ReturnSelector(steps="all")
MAX_OVER_ECHO: Final = {"HTTP": 1.5, "WebSocket": 1.3}
# Of the server's processor time of a chunk with the last image.
MAX_PROCESSOR_US: Final = {"HTTP": 340.0, "WebSocket": 220.0}
NUM_WARMING: Final = 5
MAX_DURABLE_MS: Final = 1.0
MAX_WATCHED: Final = 1.1
MAX_LISTING_MS: Final = 2.0
MIN_BATCHED: Final = 3.0
MAX_TAIL: Final = 3.0
# Those with a requirement, and others for comparison.
WAYS: Final = (
    Way("HTTP", "last image as JPEG", JPEG),
    Way("HTTP", "16 raw images", ALL),
    Way("WebSocket", "last image", LAST),
    Way("WebSocket", "16 raw images", ALL),
)
OTHERS: Final = (
    Way("HTTP", "last image", LAST),
    Way("HTTP", "last image, world in a thread", LAST, world="still in a thread"),
)
WATCHED: Final = Way("HTTP", "16 raw images, watched", ALL, is_watched=True)
DURABLE: Final = Way("HTTP", "last image, in Redis", LAST, server="durable")
DEVICES: Final = ("device", "batch device")
NUM_ROLLOUTS: Final = 32
NUM_LISTINGS: Final = 101
AMOUNTS: Final = Amounts(
    usual={"rounds": 15, "chunks": 200, "crowd_chunks": 60, "watched_rollouts": 10_000},
    quick={"rounds": 3, "chunks": 20, "crowd_chunks": 3, "watched_rollouts": 100},
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    AMOUNTS.add_options(
        parser,
        rounds="rounds",
        chunks="chunks of each way in a round",
        crowd_chunks=f"chunks of each of {NUM_ROLLOUTS} rollouts",
        watched_rollouts="open rollouts of a listing",
    )


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Time chunks of a world that computes nothing, alternating with echoes of the same bytes."""
    plan = AMOUNTS.of(options, watched_rollouts=0)
    if max(plan["chunks"], plan["crowd_chunks"]) > MAX_CHUNKS:
        raise InvalidInputError(
            f"got rollouts of {plan['chunks']} chunks and of {plan['crowd_chunks']} chunks, "
            f"expected at most {MAX_CHUNKS}"
        )
    child = ChildProcess("benchmarks.rollouts.server")
    try:
        urls = child.receive()
        ways = [*WAYS, *OTHERS, WATCHED, *([DURABLE] if DURABLE.server in urls else [])]
        times_s, taken_s, sizes = timed(urls, child.pid, ways, plan, bar)
        with bar("32 rollouts", len(DEVICES)) as step:
            crowds = {}
            for world in DEVICES:
                step(world)
                crowds[world] = crowd(urls["ours"], world, NUM_ROLLOUTS, plan["crowd_chunks"])
        # By where rollouts are kept.
        kept = {"in memory": "ours", "in Redis": DURABLE.server}
        listings_s = {
            where: listing_s(
                urls[server], num_rollouts=plan["watched_rollouts"], num_listings=NUM_LISTINGS
            )
            for where, server in kept.items()
            if server in urls
        }
    finally:
        child.close()
    bare_s = {selector: bare_step_s(selector) for selector in (LAST, JPEG, ALL)}
    over = {way: _overhead(times_s, way, bare_s[way.selector]) for way in ways}
    rates = {
        world: (one.chunks_per_s, 1e3 * one.p50_s, 1e3 * one.p99_s) for world, one in crowds.items()
    }
    listing = f"GET /v1/watch?limit=1, {plan['watched_rollouts']} rollouts"
    listings_ms = {where: 1e3 * statistics.median(found) for where, found in listings_s.items()}
    return StageReport(
        stage="rollouts",
        packages=("numpy", "fastapi", "uvicorn", "websockets", "msgpack"),
        options=plan,
        tables=[
            _table(times_s, taken_s, over, sizes),
            ResultTable(
                f"{NUM_ROLLOUTS} rollouts on a device of 5 ms",
                ("world", "chunks/s", "p50 ms", "p99 ms"),
                [(name, *(f"{value:.0f}" for value in each)) for name, each in rates.items()],
            ),
        ],
        requirements=[
            *_requirements(times_s, over, crowds),
            *_processor_requirements(taken_s),
            *(
                at_most(
                    f"{listing} {where}, with a new connection, p50", p50_ms, MAX_LISTING_MS, "ms"
                )
                for where, p50_ms in listings_ms.items()
            ),
        ],
        data={
            "seconds": times_s,
            "processor_seconds": taken_s,
            "bytes": {_name(way): size for way, size in sizes.items()},
            "bare_step_seconds": {_name(way): bare_s[way.selector] for way in ways},
            "crowds": {world: found._asdict() for world, found in crowds.items()},
            "listing_seconds": listings_s,
        },
        notes=[
            "the world computes nothing; client and server are processes of their own; medians of "
            "the chunks of a round, medians over the rounds; ratios round by round, of a chunk "
            "less the bare step of the world: over HTTP to a bare ASGI echo of the same bytes, "
            "over the WebSocket to a minimal server that unpacks, steps the same world and packs; "
            "processor times are those of the server's process, medians over the rounds"
        ],
    )


def timed(
    urls: Mapping[str, str], pid: int, ways: list[Way], plan: Mapping[str, int], bar: Bar
) -> tuple[dict[str, Figure], dict[str, Figure], dict[Way, int]]:
    """Seconds of a chunk and of what it is compared with, and bytes of the answers.

    The second are seconds of all processors that the server's process took.
    """
    sizes: dict[Way, int] = {}
    spent_s: dict[str, list[float]] = defaultdict(list)
    for way in ways:
        with opened(urls, way) as chunk:
            sizes[way] = chunk()

    def median_s(name: str, chunk: Chunk) -> float:
        before_s = processor_s(pid)
        found_s = _median_s(chunk, plan["chunks"])
        spent_s[name].append((processor_s(pid) - before_s) / (plan["chunks"] + NUM_WARMING))
        return found_s

    def ours(way: Way, _: int) -> float:
        watching = watched(urls[way.server]) if way.is_watched else nullcontext()
        with watching, opened(urls, way) as chunk:
            return median_s(_name(way), chunk)

    def other(way: Way, _: int) -> float:
        with compared(urls, way, sizes[way]) as chunk:
            return median_s(f"{_name(way)}, compared", chunk)

    subjects = {_name(way): partial(ours, way) for way in ways}
    subjects |= {f"{_name(way)}, compared": partial(other, way) for way in ways}
    with bar("rounds", plan["rounds"] * len(subjects)) as step:
        found = interleaved(subjects, plan["rounds"], on_step=step)
    times_s, taken_s = (
        {name: Figure.of(values) for name, values in some.items()} for some in (found, spent_s)
    )
    return times_s, taken_s, sizes


def bare_step_s(selector: ReturnSelector) -> float:
    """Seconds of the world's own step, in this process."""
    world, actions = StillWorld(), resting_actions(MAX_STEPS)

    def step() -> int:
        return world.step(0, actions, seed=0, selector=selector).state

    return _median_s(step, 500)


def _median_s(chunk: Chunk, count: int) -> float:
    for _ in range(NUM_WARMING):
        chunk()
    seconds = []
    for _ in range(count):
        started = time.perf_counter()
        chunk()
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds)


def _name(way: Way) -> str:
    return f"{way.protocol}, {way.answer}"


def _overhead(times_s: Mapping[str, Figure], way: Way, bare_s: float) -> Figure:
    ours, other = times_s[_name(way)], times_s[f"{_name(way)}, compared"]
    # The minimal WebSocket server takes the step, too.
    taken_s = bare_s if way.protocol == "HTTP" else 0.0
    return Figure.of([one - taken_s for one in ours.values]).over(other)


def _processor_requirements(taken_s: Mapping[str, Figure]) -> list[Requirement]:
    return [
        at_most(
            f"{_name(way)}: least processor time of the server for a chunk",
            # Zero where the system does not count it.
            1e6 * taken_s[_name(way)].low or None,
            MAX_PROCESSOR_US[way.protocol],
            "µs",
        )
        for way in (OTHERS[0], WAYS[2])
    ]


def _requirements(
    times_s: Mapping[str, Figure], over: Mapping[Way, Figure], crowds: Mapping[str, Crowd]
) -> list[Requirement]:
    beside = {"HTTP": "an echo of the same bytes", "WebSocket": "a minimal WebSocket server"}
    found = [
        at_most(
            f"{_name(way)}: a chunk over {beside[way.protocol]}, p50",
            over[way].median,
            MAX_OVER_ECHO[way.protocol],
        )
        for way in WAYS
    ]
    durable, memory = times_s.get(_name(DURABLE)), times_s[_name(OTHERS[0])]
    durable_ms = None if durable is None else 1e3 * (durable.median - memory.median)
    unwatched = times_s[_name(WAYS[1])]
    alone, batched = (crowds[world] for world in DEVICES)
    return [
        *found,
        at_most("kept in Redis: further time of a chunk, p50", durable_ms, MAX_DURABLE_MS, "ms"),
        at_most(
            "read by a watcher five times a second: a chunk over an unwatched one, p50",
            times_s[_name(WATCHED)].over(unwatched).median,
            MAX_WATCHED,
        ),
        at_least(
            "32 rollouts on a device of 5 ms: chunks/s, batched over one by one",
            batched.chunks_per_s / alone.chunks_per_s,
            MIN_BATCHED,
        ),
        at_most(
            "32 rollouts on a device of 5 ms, batched: p99 over p50",
            batched.p99_s / batched.p50_s,
            MAX_TAIL,
        ),
    ]


def _table(
    times_s: Mapping[str, Figure],
    taken_s: Mapping[str, Figure],
    over: Mapping[Way, Figure],
    sizes: Mapping[Way, int],
) -> ResultTable:
    rows = [
        (
            _name(way),
            f"{sizes[way] / 1e3:.0f}",
            times_s[_name(way)].scaled(1e3).text(),
            times_s[f"{_name(way)}, compared"].scaled(1e3).text(),
            figure.text(),
            taken_s[_name(way)].scaled(1e6).text(),
            taken_s[f"{_name(way)}, compared"].scaled(1e6).text(),
        )
        for way, figure in over.items()
    ]
    columns = ("chunk of 16 steps", "kB", "ours ms", "beside ms", "ratio", "server µs", "beside µs")
    return ResultTable("Time of a chunk", columns, rows)
