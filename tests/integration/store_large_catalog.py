"""Prints how long a catalog of many takes with real metadata takes (JSON, milliseconds).

A process of its own, since the shape checks of tests are no part of what is measured.
"""

import json
import os
import shutil
import statistics
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

from benchmarks.alignment.benchmark import record
from dextouch.episodes import EpisodeStore, GroupFingerprint
from dextouch.episodes.format import decode_commit, encode_commit, sha256_hex
from dextouch.episodes.spool import SpoolReader
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentOptions
from services.episode_store.catalog import Catalog
from services.episode_store.catalog_file import CatalogFile, transaction
from services.episode_store.catalog_index import SETTLED_NS
from services.episode_store.catalog_rows import read_row, relink, write_row
from services.episode_store.committing import commit_spool
from services.episode_store.filters import EpisodeFilter, ItemFilter, Page
from services.episode_store.items import HoursFilter

NUM_ROUNDS = 9


def fill(store, count):
    """Takes with the metadata of an aligned one, without arrays, which a catalog does not open.

    Calibration and figures of quality are most of it. Each take is a recording and its episode.
    """
    with tempfile.TemporaryDirectory() as folder:
        take = record(2.0, 0, Path(folder)).take
        commit_spool(store, take.spool_path, SpoolReader(take.spool_path).attributes)
    episode_id = align_recording(store, take.recording_id, AlignmentOptions()).episode_id
    for number in range(1, count):
        copy_take(store, take.recording_id, episode_id, f"{number:06d}")


def copy_take(store, recording_id, episode_id, suffix):
    """A take with the metadata of another one, of one of seven tasks."""
    names = {recording_id: f"r-{suffix}", episode_id: f"e-{suffix}"}
    for kind, source in (("recording", recording_id), ("episode", episode_id)):
        folder = store.root / f"{kind}s" / source
        record_of_source, _ = decode_commit((folder / "commit.json").read_bytes(), what=source)
        text = (folder / "zarr.json").read_text()
        # The longer one first: it begins with the other.
        for old in sorted(names, key=len, reverse=True):
            text = text.replace(f'"{old}"', f'"{names[old]}"')
        text = text.replace('"task":"', f'"task":"{int(suffix) % 7}_', 1)
        changed = {"id": names[source], "attributes_sha256": sha256_hex(text.encode())}
        mine = record_of_source.model_copy(update=changed)
        stage = store.root / ".staging" / f"copy-{suffix}"
        stage.mkdir(parents=True)
        (stage / "zarr.json").write_text(text)
        (stage / "commit.json").write_bytes(encode_commit(mine)[0])
        stage.rename(store.root / f"{kind}s" / names[source])


class ListedStore(EpisodeStore):
    """A store whose items are only names: their rows are in the catalog already."""

    def folder_numbers(self, *, kind="episode"):
        """Names and numbers of folders."""
        return {name: number for number, name in enumerate(self.names[kind])}

    def fingerprints(self, numbers, *, kind="episode"):
        """Fingerprints as those of the rows."""
        return {name: GroupFingerprint(number, "", "") for name, number in numbers.items()}


def rows_alone(store, folder, count):
    """A catalog of `count` episodes of a store's aligned take, written without their files."""
    listed = ListedStore(folder)
    (folder / "episodes").mkdir(parents=True)
    (episode_id,) = [name for name in store.list() if not name.startswith("e-")]
    row = read_row(store, "episode", episode_id, GroupFingerprint(0, "", ""))
    file = CatalogFile(folder)
    connection, _ = file.connection()
    listed.names = {"episode": [f"e-{number:06d}" for number in range(count)], "recording": []}
    started = time.process_time()
    for first in range(0, count, 1000):
        with transaction(connection):
            for number in range(first, min(first + 1000, count)):
                name, task = f"e-{number:06d}", f"task_{number % 7}"
                own = {"id": name, "name": f"{name},episode", "task": task, "folder": number}
                write_row(connection, replace(row, item={**row.item, **own}))
    with transaction(connection):
        relink(connection)
    return listed, (time.process_time() - started) / count * 1e3


def median_ms(work):
    """Processor time: others may use the machine."""
    times = []
    for _ in range(NUM_ROUNDS):
        started = time.process_time()
        work()
        times.append((time.process_time() - started) * 1e3)
    return round(statistics.median(times), 2)


def opened(store, count, report, name):
    """A new catalog as a new process would open it."""
    started = time.process_time()
    catalog = Catalog(store)
    assert catalog.episodes(EpisodeFilter(), limit=1).num_matching == count
    report[f"{name}_ms"] = round((time.process_time() - started) * 1e3, 1)
    return catalog


def measured(store, count):
    """Times of a catalog of `count` takes."""
    report = {"num": count}
    shutil.rmtree(store.root / ".catalog", ignore_errors=True)
    opened(store, count, report, "build")
    catalog = measured_queries(store, count, report)
    (episode_id,) = [name for name in store.list() if not name.startswith("e-")]
    (recording_id,) = [n for n in store.list(kind="recording") if not n.startswith("r-")]
    times = []
    for _ in range(NUM_ROUNDS):
        copy_take(store, recording_id, episode_id, str(time.time_ns()))
        started = time.process_time()
        catalog.items(ItemFilter(), limit=50, page=Page(sort="time", descending=True))
        times.append((time.process_time() - started) * 1e3)
    report["after_a_take_ms"] = round(statistics.median(times), 2)
    started = time.process_time()
    catalog.index.check()
    report["check_ms"] = round((time.process_time() - started) * 1e3, 1)
    sizes = [path.stat().st_size for path in (store.root / ".catalog").iterdir()]
    return report | {"catalog_bytes": sum(sizes)}


def measured_queries(store, count, report):
    """Times of queries, and the catalog."""
    catalog = opened(store, count, report, "open")
    settled_ns = time.time_ns() - 2 * SETTLED_NS
    for folder in store.root.glob("*s"):
        os.utime(folder, ns=(settled_ns, settled_ns))
    catalog.values()
    quality = ("camera_head_rate_hz:20",)
    task = catalog.values().tasks[1]
    lookups = {
        "takes": lambda: catalog.items(ItemFilter(), limit=50),
        "episodes": lambda: catalog.episodes(EpisodeFilter(), limit=50),
        "last_page": lambda: catalog.items(
            ItemFilter(), limit=50, page=Page(offset=max(count - 50, 0))
        ),
        "of_task": lambda: catalog.items(ItemFilter(task=task), limit=50),
        "of_quality": lambda: catalog.items(ItemFilter(min_quality=quality), limit=50),
        "with_text": lambda: catalog.items(ItemFilter(text="e-000012"), limit=50),
        "flagged": lambda: catalog.items(ItemFilter(flagged=True), limit=50),
        "rejected": lambda: catalog.items(ItemFilter(review="rejected"), limit=50),
        "hours": lambda: catalog.hours(EpisodeFilter()),
        "hours_by_day": lambda: catalog.hours_by("day", HoursFilter()),
        "values": catalog.values,
        "groups": catalog.groups,
        "lineage": lambda: catalog.lineage("episode", "e-000001"),
    }
    lookups |= {
        f"by_{key}": partial(
            catalog.items, ItemFilter(), limit=50, page=Page(sort=key, descending=True)
        )
        for key in ("time", "duration", "task", "operator", "station", "findings")
    }
    report |= {f"{name}_ms": median_ms(lookup) for name, lookup in lookups.items()}
    return catalog


def main(folder, count, num_rows=0):
    """Fill a store and measure; with `num_rows` also a catalog of so many rows without files."""
    store = EpisodeStore(Path(folder))
    if not store.root.is_dir():
        fill(store, int(count))
    print(json.dumps(measured(store, len(store.list()))), flush=True)  # noqa: T201
    if num_rows:
        with tempfile.TemporaryDirectory() as place:
            listed, write_ms = rows_alone(store, Path(place) / "store", int(num_rows))
            report = {"num_rows": int(num_rows), "write_ms": round(write_ms, 2)}
            measured_queries(listed, int(num_rows), report)
            print(json.dumps(report))  # noqa: T201


if __name__ == "__main__":
    main(*sys.argv[1:])
