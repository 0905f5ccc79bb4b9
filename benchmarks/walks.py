"""Trace of the files and functions that data passes through: packet, image, upload, chunk, window.

`python -m benchmarks.walks` prints one row per trace (*walk*): the number of files and functions of
`services` and `dextouch` that are entered. A long walk indicates a concept spread over many places.
"""

import argparse
import inspect
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np

import dextouch
import services
from benchmarks.rollouts.ways import resting_actions
from dextouch.clients import EpisodeStoreClient, PolicyStart, Rollout, RolloutClient
from dextouch.clocks import OnlineClock
from dextouch.command_line import add_json, write_result
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import Observation, SaveTake, TakePrompt
from dextouch.worlds import CopyFirstWorld, World, WorldServiceSettings, create_world_app
from services.acquisition.clock import VirtualClock
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.pattern import pattern_streams
from services.acquisition.settings import MockLinks
from services.acquisition.uploader import Uploader
from services.episode_store.app import create_app
from services.episode_store.settings import EpisodeStoreSettings
from services.evaluation.policies.open_loop import HoldPolicy
from services.evaluation.policies.user_policies import action_chunk, ask
from services.pipelines.servers import served

TAKE_S = 2.0
NUM_CHUNKS = 3
TASK = "walk"
_ROOTS = (Path(services.__path__[0]), Path(dextouch.__path__[0]))
_MOCKS = str(_ROOTS[0] / "acquisition/mocks/")
_PREFIXES = tuple(f"{root}/" for root in _ROOTS)


@dataclass
class Walk:
    """Files and functions that data passed through: calls by (thread, file, function)."""

    name: str
    calls: Counter[tuple[str, str, str]] = field(default_factory=Counter)

    @property
    def files(self) -> list[str]:
        """Files that were entered, relative to the packages' parents."""
        return sorted({file for _, file, _ in self.calls})

    @property
    def functions(self) -> Counter[tuple[str, str]]:
        """Number of calls by (file, function)."""
        found: Counter[tuple[str, str]] = Counter()
        for (_, *place), count in self.calls.items():
            found[place[0], place[1]] += count
        return found

    def num_calls(self, function: str, *, threads: str = "") -> int:
        """Number of calls of a function, in threads whose names begin with `threads`."""
        return sum(
            count
            for (thread, _, name), count in self.calls.items()
            if name == function and thread.startswith(threads)
        )


class Tracer:
    """Profile function that counts calls, in threads whose names begin with `threads`."""

    def __init__(self, name: str, threads: str = "") -> None:
        self.walk = Walk(name)
        self.is_on = False
        self._threads = threads
        self._lock = threading.Lock()

    def __call__(self, frame: FrameType, event: str, argument: object) -> None:
        """See `sys.setprofile`."""
        if event != "call" or not self.is_on:
            return
        place = _place(frame.f_code)
        if place is None:
            return
        thread = threading.current_thread().name
        if thread.startswith(self._threads):
            with self._lock:
                self.walk.calls[thread, *place] += 1

    @contextmanager
    def installed(self) -> Iterator["Tracer"]:
        """Trace this thread and those started in the context, while `is_on`."""
        threading.setprofile(self)
        sys.setprofile(self)
        try:
            yield self
        finally:
            self.is_on = False
            sys.setprofile(None)
            threading.setprofile(None)

    @contextmanager
    def on(self) -> Iterator[None]:
        """Count calls in the context."""
        self.is_on = True
        try:
            yield
        finally:
            self.is_on = False


@cache
def _place(code: CodeType) -> tuple[str, str] | None:
    """File and function of one of our functions, except those of mock devices."""
    prefix = next((p for p in _PREFIXES if code.co_filename.startswith(p)), None)
    # Comprehensions belong to the enclosing function. Module and class bodies run on import, which
    # does not count.
    is_function = code.co_flags & inspect.CO_NEWLOCALS and not code.co_name.startswith("<")
    if prefix is None or not is_function or code.co_filename.startswith(_MOCKS):
        return None
    return str(Path(code.co_filename).relative_to(Path(prefix).parent)), code.co_qualname


def packet_to_spool(stream: str, *, links: MockLinks | None = None) -> Walk:
    """From the read of a packet or image to its record in the spool, in the reader's thread."""
    device = stream.replace("tactile_", "glove_")
    tracer = Tracer(f"{stream} → spool", threads=f"read-{device}")
    streams = [s for s in pattern_streams(TAKE_S) if s.descriptor.name == stream]
    with (
        tempfile.TemporaryDirectory() as folder,
        tracer.installed(),
        MockStation(
            streams, FaultScript(), 0, VirtualClock(), spool_root=Path(folder), links=links
        ) as station,
        # Connected; from here on only the take is traced.
        tracer.on(),
    ):
        station.run_take(TakePrompt(task=TASK, instruction=TASK))
    return tracer.walk


def upload() -> Walk:
    """From one glove's take in the spool to its recording in the store, on both sides of HTTP."""
    streams = [s for s in pattern_streams(TAKE_S) if s.descriptor.name == "tactile_left"]
    tracer = Tracer("recording upload, one glove")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with MockStation(
            streams, FaultScript(), 0, VirtualClock(), spool_root=folder / "spool"
        ) as station:
            how = SaveTake(accept_incomplete=True)
            station.run_take(TakePrompt(task=TASK, instruction=TASK), how=how)
        app = create_app(EpisodeStoreSettings(store_url=str(folder / "store")))
        with (
            tracer.installed(),
            served({"store": app}) as urls,
            EpisodeStoreClient(urls["store"]) as client,
        ):
            uploader = Uploader(folder / "spool", client, period_s=1.0)
            with tracer.on():
                uploader.upload_all()
    return tracer.walk


def action_chunk_walk(world: World[Any] | None = None) -> Walk:
    """From a policy's chunk to its observation, on both sides of HTTP.

    The default world is the baseline, which computes nothing.
    """
    walked = world or CopyFirstWorld(tasks=(TASK,))
    tracer = Tracer(f"action chunk, {walked.description.name}")
    app = create_world_app({"world": walked}, WorldServiceSettings(), name="world")
    with (
        tracer.installed(),
        served({"world": app}) as urls,
        RolloutClient(urls["world"]) as client,
        _started(client, walked) as rollout,
    ):
        policy = HoldPolicy()
        policy.reset(PolicyStart(TASK, TASK, 0, rollout.anchor, rollout.K_head))
        for _ in range(NUM_CHUNKS):
            answer = ask(policy.act, rollout.observation, where=TASK)
            with tracer.on():
                # As `services.evaluation.closed_loop` plays it.
                chunk = action_chunk(answer, walked.description, where=TASK)
                rollout.step(chunk, validated=True)
    return tracer.walk


def _started(client: RolloutClient, world: World[Any]) -> Rollout:
    description, task = world.description, world.description.tasks[0]
    init = None
    if "task_seed" not in description.starts_from:
        size = (1, description.image_height_px, description.image_width_px, 3)
        first = Observation(
            first_step=0,
            images={camera: np.zeros(size, dtype=np.uint8) for camera in description.cameras},
            tactile_kpa=np.zeros((1, 2, 320), dtype=np.float32),
            action_reached=resting_actions(1),
            reached_is_measured=True,
        )
        init = (first, AnchorPoses(np.eye(4), np.eye(4), np.eye(4)), np.eye(3))
    return client.start(world="world", task=task, seed=0, instruction=task, init=init)


def window_into_training(store_url: str) -> Walk:
    """From an episode of a store to the network's input, as the streaming loader reads it."""
    from services.world_model.network.configuration import NetworkConfig
    from services.world_model.network.inputs import build_inputs
    from services.world_model.training.joint_dataset import WindowPosition, index_episodes

    (episode, *_) = index_episodes(store_url)
    tracer = Tracer("window into training")
    with tracer.installed(), tracer.on():
        window = episode.cut(WindowPosition(0, 0, 5))
        size_px = window.images.shape[1]
        build_inputs([window.request], NetworkConfig(image_px=size_px))
    return tracer.walk


def clock_stamp() -> Walk:
    """From timestamp and arrival to the estimated time of a sample, online."""
    clock = OnlineClock()
    tracer = Tracer("clock stamp")
    with tracer.installed(), tracer.on():
        for index in range(600):
            t_device_ns = index * 16_666_667
            t_host_ns = 10**15 + t_device_ns + index % 7 * 10**5
            clock.update(t_host_ns=t_host_ns, t_device_ns=t_device_ns)
    return tracer.walk


WALKS: Mapping[str, Callable[[], Walk]] = {
    "glove": lambda: packet_to_spool("tactile_left"),
    "image": lambda: packet_to_spool("camera_head", links=MockLinks(images="h264")),
    "upload": upload,
    "chunk": action_chunk_walk,
    "clock": clock_stamp,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Measure the walks and print them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.walks", description=__doc__)
    parser.add_argument("--only", choices=list(WALKS), help="one walk")
    parser.add_argument("--episodes", metavar="STORE", help="also a window of this store's episode")
    parser.add_argument(
        "--functions", action="store_true", help="list every function with its calls"
    )
    add_json(parser)
    options = parser.parse_args(argv)
    chosen = [options.only] if options.only else list(WALKS)
    walks = [WALKS[name]() for name in chosen]
    if options.episodes:
        walks.append(window_into_training(options.episodes))
    for walk in walks:
        print(f"{walk.name:30s} {len(walk.files):3d} files {len(walk.functions):4d} functions")
        for (file, function), count in sorted(walk.functions.items()) if options.functions else ():
            print(f"    {count:6d} {file}: {function}")
    found = {
        walk.name: {"files": walk.files, "num_functions": len(walk.functions)} for walk in walks
    }
    write_result(options.json, found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
