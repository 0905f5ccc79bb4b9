"""Orders on standard input, a line each; for each a process that writes until it is killed.

Whoever gives the orders kills the process. What it had handed over by then is in a file that both
have mapped, so it is exact to the sample. Processes are forked from this one, which has imported
everything: a trial costs its own time only.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np

from dextouch.episodes import EpisodeStore
from dextouch.episodes.spool import SpoolWriter
from tests.system import take_source

SAVED, SAVED_SECONDS = ("saved-0", "saved-1"), 0.6
FLIGHT = "flight"
SPOOL_BLOCK = 3
# What a process can do to files; each is announced before it happens.
FILE_EVENTS = frozenset({"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate"})


class Counters:
    """How many samples of each stream were handed over, in a file that outlives us."""

    def __init__(self, path, *, create=False):
        size = (2, len(take_source.STREAM_NAMES))
        if create:
            np.zeros(size, np.int64).tofile(path)
        self._table = np.memmap(path, dtype=np.int64, mode="r+", shape=size)

    def add(self, name, number=1):
        self._table[0, take_source.STREAM_NAMES.index(name)] += number

    def get(self, name):
        return int(self._table[0, take_source.STREAM_NAMES.index(name)])

    @property
    def file_events(self):
        return int(self._table[1, 0])

    @file_events.setter
    def file_events(self, number):
        self._table[1, 0] = number


def main():
    images = np.load(sys.argv[1])
    jpegs = take_source.encode_jpegs(images)
    say("ready")
    for line in sys.stdin:
        order = json.loads(line)
        pid = os.fork()
        if pid == 0:
            work = {"live": write_take, "commit": write_take, "spool": spool, "sweep": sweep}
            work[order["mode"]](order, images, jpegs)
            say("done")
            signal.pause()
        _, status = os.waitpid(pid, 0)
        say(f"ended {os.waitstatus_to_exitcode(status)}")


def write_take(order, images, _jpegs):
    """Two recordings that are finished, and one in flight, as a station hands them over."""
    store, counters = EpisodeStore(order["root"]), Counters(order["counters"])
    for number, recording_id in enumerate(SAVED):
        with open_writer(store, recording_id) as writer:
            for _, name, k in take_source.schedule(SAVED_SECONDS):
                writer.append(name, **take_source.block(name, number, k, 1, images))
    live = order["mode"] == "live"
    with open_writer(store, FLIGHT) as writer:
        say(f"recording {os.getpid()}")
        start_s = time.monotonic()
        for due_s, name, k in take_source.schedule(order["seconds"]):
            if live:
                time.sleep(max(0.0, start_s + due_s - time.monotonic()))
            writer.append(name, **take_source.block(name, order["seed"], k, 1, images))
            counters.add(name)
        if not live:
            kill_at_file_event(order["kill_at"], counters)


def open_writer(store, recording_id):
    return store.writer(kind="recording", attributes=take_source.attributes(recording_id))


def spool(order, _images, jpegs):
    """A spool that gets blocks of several samples, images among them."""
    counters = Counters(order["counters"])
    attributes = take_source.attributes(FLIGHT, camera_unit="jpeg")
    writer = SpoolWriter(Path(order["root"]) / FLIGHT, attributes)
    say(f"recording {os.getpid()}")
    start_s = time.monotonic()
    for due_s, name, k in take_source.schedule(order["seconds"]):
        if k % SPOOL_BLOCK:
            continue
        time.sleep(max(0.0, start_s + due_s - time.monotonic()))
        writer.append(name, take_source.spool_batch(name, order["seed"], k, SPOOL_BLOCK, jpegs))
        counters.add(name, SPOOL_BLOCK)


def sweep(order, _images, _jpegs):
    """The removal of what an earlier process left, itself killed."""
    say(f"recording {os.getpid()}")
    kill_at_file_event(order["kill_at"], Counters(order["counters"]))
    EpisodeStore(order["root"]).sweep()


def kill_at_file_event(number, counters):
    """Die just before the file event of this number from now on; -1 only counts them."""

    def hook(event, _arguments):
        if event in FILE_EVENTS:
            if counters.file_events == number:
                os.kill(os.getpid(), signal.SIGKILL)
            counters.file_events += 1

    sys.addaudithook(hook)


def say(words):
    os.write(sys.stdout.fileno(), f"{words}\n".encode())


if __name__ == "__main__":
    main()
