"""Kill workers of a local Ray cluster while takes are recorded; opt-in: make check-ray.

Runs in an environment of its own, which has Ray. The store must then hold every take once, equal to
what one process records.
"""

import argparse
import json
import os
import random
import signal
import tempfile
import threading
import time

import psutil
import ray

from dextouch.episodes import EpisodeStore
from dextouch.errors import UnavailableError
from dextouch.jobs import Workers, run_jobs
from services.cli.main import main as dextouch

NUM_WORKERS = 2
# Of each task; the first takes wait for workers to start.
NUM_TAKES = 6


def workers():
    """Process ids of workers with a job."""
    return [
        process.info["pid"]
        for process in psutil.process_iter(["cmdline", "pid"])
        if any(word.startswith("ray::_attempt") for word in process.info["cmdline"] or ())
    ]


def nothing(item):
    return item


def end(item):
    os.kill(os.getpid(), signal.SIGKILL)


def take_by_take(folder, where):
    """Record takes of the twin; their content by id."""
    words = f"twin record --task stand_bottle --seeds 0:{NUM_TAKES} --cameras --store {folder}"
    assert dextouch([*words.split(), *where]) == 0
    store = EpisodeStore(folder)
    assert not store.sweep()
    return {
        one: store.open(one).verify() and store.open(one).content_sha256 for one in store.list()
    }


def kill_some(num_kills, rng, stop, killed):
    while len(killed) < num_kills and not stop.is_set():
        time.sleep(rng.uniform(1.0, 3.0))
        if found := workers():
            pid = rng.choice(found)
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)


def overhead_s(where, num_jobs=300):
    # The first jobs start the workers.
    items = list(range(num_jobs))
    list(run_jobs(nothing, items[:20], where))
    start_s = time.perf_counter()
    assert sorted(job.result() for job in run_jobs(nothing, items, where)) == items
    return (time.perf_counter() - start_s) / num_jobs


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=3)
    num_kills = parser.parse_args().kills
    rng, killed, stop = random.Random(num_kills), [], threading.Event()
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        expected = take_by_take(f"{folder}/alone", ("--jobs", "1"))
        ray.init(address="local", num_cpus=NUM_WORKERS, log_to_driver=False, logging_level="error")
        cluster = Workers(ray_address="local")
        figures["ms a job on Ray"] = 1e3 * overhead_s(cluster)
        killer = threading.Thread(target=kill_some, args=(num_kills, rng, stop, killed))
        killer.start()
        start_s = time.perf_counter()
        got = take_by_take(f"{folder}/cluster", ("--ray", "local"))
        figures["s with kills"] = time.perf_counter() - start_s
        stop.set()
        killer.join()
        # Again: everything is there, so nothing is recorded twice.
        again = take_by_take(f"{folder}/cluster", ("--ray", "local"))
        lost = [job.error for job in run_jobs(end, [0], cluster)]
        ray.shutdown()
    assert got == again == expected, (sorted(expected), sorted(got))
    assert killed, "no worker was killed: the takes ended too early"
    assert isinstance(lost[0], UnavailableError), lost
    figures |= {"takes": len(got), "killed": len(killed), "lost, wrong or doubled": 0}
    print(json.dumps(figures, indent=1))  # noqa: T201 - it is what the check is run for


if __name__ == "__main__":
    main()
