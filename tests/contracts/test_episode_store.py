"""One suite for every kind of storage: what an episode store promises, in a folder and over S3."""

import os
import pickle
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    InvalidInputError,
    NotFoundError,
)
from dextouch.schemas import RecordingAttributes, Review
from dextouch.streams import StreamDescriptor
from tests.contracts.s3_server import CREDENTIALS, running_s3
from tests.unit.episodes.conftest import episode_of

EPISODE = "stand-bottle-0003"
NOON = datetime(2026, 5, 4, 12, tzinfo=UTC)
FORCE = StreamDescriptor(
    name="force", kind="scalar", shape=(2,), dtype="float32", unit="N", nominal_rate_hz=10
)


class Place:
    """Stores of one place as several machines see it, and its files by key."""

    def __init__(self, folder: Path, server=None, prefix=""):
        self._folder, self._server, self._prefix = folder, server, prefix
        self._num_machines = 0
        self.store = self.again()

    def again(self) -> EpisodeStore:
        """The same place from another machine."""
        if self._server is None:
            return EpisodeStore(self._folder)
        self._num_machines += 1
        work = self._folder / str(self._num_machines)
        return EpisodeStore(
            self._server.url(self._prefix), CREDENTIALS | {"work_folder": str(work)}
        )

    @property
    def _bucket(self):
        return self.store._storage._bucket

    def keys(self, folder):
        if self._server is not None:
            return [facts.key for facts in self._bucket.list(folder)]
        files = (self._folder / folder).rglob("*")
        return [path.relative_to(self._folder).as_posix() for path in files if path.is_file()]

    def change(self, key, edit):
        """Replace a file by what `edit` makes of its bytes; None removes it."""
        if self._server is None:
            path = self._folder / key
            data = edit(path.read_bytes())
            path.unlink()
            if data is not None:
                path.write_bytes(data)
            return
        data = edit(self._bucket.get(key))
        self._bucket.remove([key])
        if data is not None:
            self._bucket.put(key, data)


@pytest.fixture(scope="session")
def s3_server():
    with running_s3() as server:
        yield server


@pytest.fixture(params=["folder", "s3"])
def place(request, tmp_path):
    if request.param == "folder":
        return Place(tmp_path / "store")
    return Place(tmp_path, request.getfixturevalue("s3_server"), tmp_path.name)


@pytest.fixture
def store(place):
    return place.store


@pytest.fixture(scope="session")
def made():
    return episode_of(camera_unit="h264")


@pytest.fixture(scope="session")
def reference(made, tmp_path_factory):
    return made.write(EpisodeStore(tmp_path_factory.mktemp("reference")))


def begin_recording(store, recording_id="take-1", num_samples=40):
    writer = store.writer(
        kind="recording",
        attributes=RecordingAttributes(
            recording_id=recording_id,
            station="s1",
            task="t",
            instruction="press",
            domain="human",
            started_at="2026-11-01T10:00:00Z",
        ),
    )
    writer.add_stream(FORCE)
    values = np.arange(2 * num_samples, dtype=np.float32).reshape(-1, 2)
    stamps = np.arange(num_samples, dtype=np.int64) * 10**8
    writer.append("force", values=values, t_host_ns=stamps)
    return writer, values


def die(writer):
    """What the end of its process does to a writer: its lock goes, its files stay."""
    for stream in writer._streams.values():
        stream.close()
    os.close(writer._lock)


@pytest.mark.long
def test_everything_comes_back_equal(made, place, reference):
    made.write(place.store)
    reader = place.again().open(EPISODE)
    assert reader.attributes == reference.attributes
    assert reader.content_sha256 == reference.content_sha256
    for name in made.values:
        np.testing.assert_array_equal(reader.read(name).values, reference.read(name).values)
        np.testing.assert_array_equal(reader.stamps_ns(name), made.stamps_ns[name])
    assert reader.verify() == reference.verify()
    assert reader.encoded_images("camera_head", 3, 12) == reference.encoded_images(
        "camera_head", 3, 12
    )


@pytest.mark.long
@pytest.mark.parametrize(("start", "num_steps"), [(0, 17), (4, 17), (20, 1)])
def test_windows(made, place, reference, start, num_steps):
    made.write(place.store)
    cameras = ("camera_head", "camera_wrist_left", "camera_wrist_right")
    ours, theirs = (
        reader.window(start, num_steps, cameras=cameras)
        for reader in (place.again().open(EPISODE), reference)
    )
    for camera in cameras:
        np.testing.assert_array_equal(ours.images[camera], theirs.images[camera])
        np.testing.assert_array_equal(ours.image_dt_ns[camera], theirs.image_dt_ns[camera])
    np.testing.assert_array_equal(ours.tactile_kpa, theirs.tactile_kpa)
    np.testing.assert_array_equal(ours.actions, theirs.actions)


@pytest.mark.long
def test_kinds_are_listed_apart(made, place):
    for episode_id in ("b", "a"):
        made.write(place.store, episode_id=episode_id)
    with begin_recording(place.store)[0]:
        pass
    other = place.again()
    assert other.list() == ["a", "b"]
    assert other.list(kind="recording") == ["take-1"]
    assert other.exists("a")
    assert not other.exists("a", kind="recording")
    assert other.recording("take-1").num_samples("force") == 40


def test_nothing_is_seen_before_commit(store, place):
    writer, values = begin_recording(store)
    with writer:
        assert place.again().list(kind="recording") == []
        assert store.sweep() == 0
    np.testing.assert_array_equal(place.again().recording("take-1").read("force").values, values)
    assert place.keys(".staging") == []


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_exception_leaves_nothing_of_a_take(store, place, error):
    writer, _ = begin_recording(store)
    with pytest.raises(error, match="glove fell off"), writer:
        raise error("glove fell off")
    assert place.keys("recordings") == []
    assert nothing_waits(store)


def test_of_two_writers_of_one_id_the_first_to_commit_wins(place):
    first, values = begin_recording(place.store)
    second, _ = begin_recording(place.again(), num_samples=7)
    with first:
        pass
    with pytest.raises(ConflictError, match="exists already"):
        second.__exit__(None, None, None)
    with pytest.raises(ConflictError, match="exists already"):
        begin_recording(place.again())
    reader = place.again().recording("take-1")
    np.testing.assert_array_equal(reader.read("force").values, values)
    reader.verify()


def test_nothing_is_left_of_a_writer_whose_id_was_taken(place):
    late, _ = begin_recording(place.store)
    with begin_recording(place.again(), num_samples=4)[0]:
        pass
    with pytest.raises(ConflictError, match="exists already"):
        late.__exit__(None, None, None)
    assert place.again().list(kind="recording") == ["take-1"]
    assert nothing_waits(place.store)


def nothing_waits(store):
    """Neither a stage nor an upload is left on this machine."""
    return store.complete_uploads() == () and not any(
        (store.root / folder).is_dir() and any((store.root / folder).iterdir())
        for folder in (".staging", ".outbox/recordings")
    )


def test_an_id_can_be_used_again_after_it_was_deleted(place):
    other = place.again()
    with begin_recording(place.store, num_samples=9)[0]:
        pass
    before = place.store.fingerprints({"take-1": 0}, kind="recording")
    assert other.fingerprints({"take-1": 0}, kind="recording") == before
    other.delete("take-1", kind="recording")
    assert place.keys("recordings") == []
    assert place.store.list(kind="recording") == []
    with pytest.raises(NotFoundError, match="take-1"):
        place.store.recording("take-1")
    with begin_recording(place.store, num_samples=30)[0]:
        pass
    assert other.recording("take-1").num_samples("force") == 30
    assert other.fingerprints({"take-1": 0}, kind="recording") != before


def test_what_is_not_there(store):
    for ask in (store.open, store.delete, store.num_bytes):
        with pytest.raises(NotFoundError, match="nothing-here"):
            ask("nothing-here")
    for wrong in ("../up", "a/b", "", "A"):
        with pytest.raises(InvalidInputError, match="expected 1 … 128"):
            store.open(wrong)
    assert store.list() == []
    assert store.complete_uploads() == ()
    assert store.sweep() == 0


def test_a_sweep_removes_what_a_dead_writer_left_and_nothing_else(store, place):
    with begin_recording(store, "whole")[0]:
        pass
    running, _ = begin_recording(store, "running")
    die(begin_recording(store)[0])
    assert store.sweep() == 1
    assert len(list((store.root / ".staging").iterdir())) == 1
    with running:
        pass
    assert place.again().list(kind="recording") == ["running", "whole"]
    # Its id is free.
    writer, values = begin_recording(place.again())
    with writer:
        pass
    np.testing.assert_array_equal(store.recording("take-1").read("force").values, values)
    assert store.sweep() == 0


@pytest.mark.long
@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[:20] + bytes([data[20] ^ 1]) + data[21:],
        lambda data: data[:-1],
        lambda data: data[: len(data) // 2],
        lambda data: b"",
        lambda _: None,
    ],
    ids=["flipped", "one-byte-short", "half", "empty", "missing"],
)
def test_damaged_arrays_are_named(made, place, damage):
    made.write(place.store)
    place.change(f"episodes/{EPISODE}/tactile_left/c/0/0", damage)
    reader = place.again().open(EPISODE)
    for ask in (lambda: reader.read("tactile_left"), reader.verify):
        with pytest.raises(CorruptDataError, match="tactile_left"):
            ask()
    np.testing.assert_array_equal(reader.read("action").values, made.values["action"])


@pytest.mark.long
@pytest.mark.parametrize("name", ["commit.json", "zarr.json"])
def test_damaged_records_are_refused(made, place, name):
    made.write(place.store)
    place.change(f"episodes/{EPISODE}/{name}", lambda data: data.replace(b"1", b"2", 1))
    with pytest.raises(CorruptDataError, match=EPISODE):
        place.again().open(EPISODE)


@pytest.mark.long
def test_readers_are_shared_by_threads_and_pickled(made, place, reference):
    reader = made.write(place.store)
    carried = pickle.loads(pickle.dumps(reader))  # noqa: S301 our own bytes, as a data loader's
    with ThreadPoolExecutor(6) as pool:
        windows = list(pool.map(lambda k: (k, carried.window(k % 5, 9)), range(24)))
    for number, window in windows:
        expected = reference.window(number % 5, 9)
        np.testing.assert_array_equal(window.images["camera_head"], expected.images["camera_head"])
        np.testing.assert_array_equal(window.tactile_kpa, expected.tactile_kpa)


@pytest.mark.long
def test_a_groups_size_is_that_of_its_files(place, made):
    made.write(place.store)
    sizes = []
    for key in place.keys(f"episodes/{EPISODE}"):
        place.change(key, lambda data: sizes.append(len(data)) or data)
    assert place.again().num_bytes(EPISODE) == sum(sizes) > 0
    with pytest.raises(NotFoundError):
        place.store.num_bytes("nobody")


@pytest.mark.long
def test_a_review_stays_beside_the_content(place, made):
    made.write(place.store)
    assert place.store.review(EPISODE) is None
    before = place.store.open(EPISODE).content_sha256
    for verdict in ("rejected", "accepted"):
        review = Review(verdict=verdict, reason="slipped", reviewer="mika", reviewed_at=NOON)
        place.store.set_review(EPISODE, review)
        assert place.again().review(EPISODE) == review
    assert place.store.open(EPISODE).verify().content_sha256 == before
    place.store.set_review(EPISODE, None)
    place.store.set_review(EPISODE, None)
    assert place.again().review(EPISODE) is None
    place.store.set_review(EPISODE, review)
    place.store.delete(EPISODE, for_good=True)
    made.write(place.store)
    assert place.store.review(EPISODE) is None
    with pytest.raises(NotFoundError):
        place.store.set_review("another", review)
    with pytest.raises(NotFoundError):
        place.store.review("another")
