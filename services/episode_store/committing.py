"""Commit of complete spools as recordings of the store, here or in a child process.

Copying a take costs as much as receiving it, and would delay all stations in the process that
acknowledges batches.
"""

import sys
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

from dextouch.episodes import ContentDigest, EpisodeStore
from dextouch.episodes.spool import SpoolReader
from dextouch.errors import ConflictError, DexTouchError, UnavailableError
from dextouch.schemas import (
    Problem,
    RecordingAttributes,
    StreamContent,
    error_from_problem,
    problem_from_error,
)
from dextouch.serving import ChildProcess, serve_parent
from dextouch.streams import ENCODED_UNITS

# Acknowledging batches has priority over committing.
NICENESS = 5
RETRY_AFTER_S = 1
COPY_SAMPLES = 256
COPY_BYTES = 4 << 20
# Images take about 50 kB each.
COPY_IMAGES = 32

# What each stream of a recording is to have; empty if the station did not say.
Content = Mapping[str, StreamContent]
NOTHING: Content = MappingProxyType({})
# Commits the spool in a folder with its final attributes, if it has the announced content.
Commit = Callable[[Path, RecordingAttributes, Content], dict[str, int]]


def check_content(recording_id: str, got: Content, announced: Content) -> None:
    """Raise ConflictError if streams have other samples than announced; none announced: nothing."""
    differing = {
        name: {"got": got[name].model_dump(), "expected": expected.model_dump()}
        for name, expected in announced.items()
        if got[name] != expected
    }
    if differing:
        listed = ", ".join(
            f"{name} has {got[name].num_samples} samples and sha256 {got[name].sha256[:12]}, "
            f"expected {announced[name].num_samples} and {announced[name].sha256[:12]}"
            for name in differing
        )
        raise ConflictError(
            f"finish {recording_id}: the store has other samples: {listed}; keep the take, and "
            "delete what the store has under this id, or expire the upload",
            **differing,
        )


def commit_spool(
    store: EpisodeStore, spool: Path, attributes: RecordingAttributes, announced: Content = NOTHING
) -> dict[str, int]:
    """Copy a closed spool to a new recording; returns the number of samples by stream.

    Raises ConflictError if the recording exists or the spool has other samples than announced,
    CorruptDataError if it is damaged, StorageFullError without space; nothing is written then.
    """
    reader = SpoolReader(spool)
    with store.writer(kind="recording", attributes=attributes) as writer:
        for name, descriptor in reader.streams.items():
            fitting = max(1, min(COPY_SAMPLES, COPY_BYTES // descriptor.sample_bytes()))
            num_samples = COPY_IMAGES if descriptor.unit in ENCODED_UNITS else fitting
            total, digest = reader.num_samples(name), ContentDigest(descriptor)
            for start in range(0, total, num_samples):
                batch = reader.read(name, start, min(start + num_samples, total))
                writer.append(name, **vars(batch))
                if name in announced:
                    digest.add(batch)
            if name in announced:
                got = {name: digest.content()}
                check_content(attributes.recording_id, got, {name: announced[name]})
    return {name: reader.num_samples(name) for name in reader.streams}


class CommitProcess:
    """A `Commit` in a child process, one spool at a time; started on first use."""

    def __init__(self, store_url: str) -> None:
        self._store_url = store_url
        self._child: ChildProcess | None = None
        self._guard = threading.Lock()

    def __call__(
        self, spool: Path, attributes: RecordingAttributes, announced: Content = NOTHING
    ) -> dict[str, int]:
        """Commit a spool; raises as `commit_spool`.

        Raises UnavailableError: the process died; the spool is unchanged.
        """
        with self._guard:
            if self._child is None or not self._child.is_running:
                self._child = ChildProcess("services.episode_store.committing", self._store_url)
            self._child.send(
                {
                    "spool": str(spool),
                    "attributes": attributes.model_dump_json(),
                    "announced": {name: one.model_dump() for name, one in announced.items()},
                }
            )
            try:
                answer = self._child.receive()
            except UnavailableError as error:
                raise UnavailableError(
                    f"finish {attributes.recording_id}: the process that writes recordings died: "
                    f"{error.message}; try again",
                    retry_after_s=RETRY_AFTER_S,
                ) from error
        if "problem" in answer:
            raise error_from_problem(Problem.model_validate(answer["problem"]))
        counts: dict[str, int] = answer["num_samples"]
        return counts

    def close(self) -> None:
        """Wait for the running commit and end the process."""
        with self._guard:
            if self._child is not None:
                self._child.close()
                self._child = None


def serve(store_url: str) -> None:
    """Commit spools on request of the parent, until it ends."""
    orders, answer = serve_parent(niceness=NICENESS)
    store = EpisodeStore(store_url)
    for order in orders:
        attributes = RecordingAttributes.model_validate_json(order["attributes"])
        announced = {
            name: StreamContent.model_validate(one) for name, one in order["announced"].items()
        }
        try:
            counts = commit_spool(store, Path(order["spool"]), attributes, announced)
            answer({"num_samples": counts})
        except DexTouchError as error:
            problem = problem_from_error(error, instance=attributes.recording_id, request_id="")
            answer({"problem": problem.model_dump()})


if __name__ == "__main__":
    serve(sys.argv[1])
