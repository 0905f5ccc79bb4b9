"""A folder and a count in, how long a catalog of so many episodes takes out (JSON, milliseconds).

A process of its own, since the shape checks of tests are no part of what is measured.
"""

import json
import os
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.alignment.benchmark import record
from dextouch.episodes import EpisodeStore
from dextouch.episodes.format import decode_commit, encode_commit, group_metadata, sha256_hex
from dextouch.episodes.spool import SpoolReader
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentOptions
from services.episode_store.catalog import SETTLED_NS, Catalog
from services.episode_store.committing import commit_spool
from services.episode_store.filters import EpisodeFilter

NUM_ROUNDS = 9


def fill(store, count):
    """Copies of the metadata of an aligned take, without its arrays, which a catalog does not open.

    Calibration and figures of quality are most of it, and most of the time of a scan.
    """
    with tempfile.TemporaryDirectory() as folder:
        take = record(2.0, 0, Path(folder)).take
        commit_spool(store, take.spool_path, SpoolReader(take.spool_path).attributes)
    episode_id = align_recording(store, take.recording_id, AlignmentOptions()).episode_id
    source = store.root / "episodes" / episode_id
    record_of_source, _ = decode_commit((source / "commit.json").read_bytes(), what=episode_id)
    attributes = json.loads((source / "zarr.json").read_bytes())["attributes"]["dextouch"]
    for number in range(1, count):
        folder = store.root / "episodes" / f"e-{number:05d}"
        folder.mkdir()
        own = {"episode_id": folder.name, "task": f"task_{number % 7}"}
        group = group_metadata(attributes | own, record_of_source.arrays)
        changed = {"id": folder.name, "attributes_sha256": sha256_hex(group)}
        mine = record_of_source.model_copy(update=changed)
        (folder / "zarr.json").write_bytes(group)
        (folder / "commit.json").write_bytes(encode_commit(mine)[0])


def median_ms(work):
    """Of some rounds."""
    times = []
    for _ in range(NUM_ROUNDS):
        started = time.perf_counter()
        work()
        times.append((time.perf_counter() - started) * 1e3)
    return sorted(times)[NUM_ROUNDS // 2]


def main(folder, count):
    """Fill a store and measure."""
    store = EpisodeStore(Path(folder))
    fill(store, int(count))
    catalog, everything = Catalog(store), EpisodeFilter()
    started, cpu_s = time.perf_counter(), time.process_time()
    found = catalog.episodes(everything, limit=10**6)
    report = {
        "num": found.num_matching,
        "first_scan_ms": (time.perf_counter() - started) * 1e3,
        "first_scan_cpu_ms": (time.process_time() - cpu_s) * 1e3,
    }
    now_ns = time.time_ns()
    wanted = EpisodeFilter(task="task_3", min_quality=("camera_head_rate_hz:20",))
    for name, age_ns in (("young", 0), ("settled", 2 * SETTLED_NS)):
        os.utime(store.root / "episodes", ns=(now_ns - age_ns, now_ns - age_ns))
        catalog.episodes(everything, limit=1)
        report[f"{name}_list_ms"] = median_ms(lambda: catalog.episodes(everything, limit=10**6))
        report[f"{name}_filtered_ms"] = median_ms(lambda: catalog.episodes(wanted, limit=1000))
        report[f"{name}_hours_ms"] = median_ms(lambda: catalog.hours(everything))
    print(json.dumps(report))  # noqa: T201


if __name__ == "__main__":
    main(*sys.argv[1:])
