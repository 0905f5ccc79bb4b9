"""Object storage: addresses, uploads that die, deletions, and services that refuse."""

import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
import zarr
from obstore.store import S3Store
from structlog.testing import capture_logs
from zarr.storage import ObjectStore

from dextouch.episodes import EpisodeStore, bucket_storage
from dextouch.episodes.bucket_storage import BLOCK_BYTES, ORPHAN_AGE, sweep_orphans
from dextouch.episodes.s3_bucket import Bucket
from dextouch.errors import (
    InvalidInputError,
    NotFoundError,
    StorageError,
    UnavailableError,
)
from dextouch.schemas import RecordingAttributes, Review
from dextouch.streams import StreamDescriptor
from tests.contracts.s3_server import CREDENTIALS, running_s3
from tests.unit.episodes.conftest import episode_of

EPISODE = "stand-bottle-0003"
FORCE = StreamDescriptor(
    name="force", kind="scalar", shape=(2,), dtype="float32", unit="N", nominal_rate_hz=10
)


@pytest.fixture(scope="session")
def s3_server():
    with running_s3() as server:
        yield server


@pytest.fixture
def url(s3_server, tmp_path):
    return s3_server.url(f"unit/{tmp_path.name}")


@pytest.fixture
def store(url, tmp_path):
    return EpisodeStore(url, CREDENTIALS | {"work_folder": str(tmp_path / "work")})


@pytest.fixture
def bucket(store):
    return store._storage._bucket


def test_a_work_folder_belongs_to_one_address(made, store, s3_server):
    made.write(store)
    elsewhere = EpisodeStore(
        s3_server.url("unit/elsewhere"), CREDENTIALS | {"work_folder": str(store.root)}
    )
    with pytest.raises(InvalidInputError, match="belongs to another address"):
        made.write(elsewhere)
    assert elsewhere.list() == []


def test_a_bucket_that_is_not_there(s3_server, made, tmp_path):
    store = EpisodeStore(
        s3_server.url("p", bucket="nowhere"), CREDENTIALS | {"work_folder": str(tmp_path)}
    )
    asks = (store.list, lambda: store.open("x"), lambda: store.exists("x"), store.sweep)
    for ask in (*asks, lambda: made.write(store)):
        with pytest.raises(StorageError, match="'nowhere' does not exist; create it first"):
            ask()


def test_wrong_credentials_are_said_to_be_wrong(s3_server, store, made):
    made.write(store)
    with s3_server.checking_credentials():
        for ask in (store.list, lambda: store.open(EPISODE), lambda: store.exists("x")):
            with pytest.raises(StorageError, match=r"refused.*check the credentials") as caught:
                ask()
            assert CREDENTIALS["secret_access_key"] not in str(caught.value)
    assert store.list() == [EPISODE]


def test_what_is_not_given_comes_from_the_usual_environment(s3_server, monkeypatch, made, tmp_path):
    for name, value in {
        "AWS_ACCESS_KEY_ID": "tester",
        "AWS_SECRET_ACCESS_KEY": "x",
        "AWS_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{s3_server.port}",
        "AWS_ALLOW_HTTP": "true",
    }.items():
        monkeypatch.setenv(name, value)
    store = EpisodeStore(f"s3://takes/environment?work_folder={tmp_path}")
    assert made.write(store).content_sha256
    assert store.root == tmp_path
    assert store.list() == [EPISODE]


def test_a_server_that_is_not_there(tmp_path, unused_port):
    options = CREDENTIALS | {"max_retries": "1", "retry_timeout_s": "1"}
    url = f"s3://b/p?endpoint=http://127.0.0.1:{unused_port}&region=eu"
    with pytest.raises(UnavailableError, match=r"no answer.*check endpoint"):
        EpisodeStore(f"{url}&allow_http=true", options | {"work_folder": str(tmp_path)}).list()
    with pytest.raises(StorageError, match="needs the option allow_http=true"):
        EpisodeStore(url, options | {"work_folder": str(tmp_path)}).list()


@pytest.fixture
def unused_port():
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


DYING_WRITER = """
import os, signal, sys
from dextouch.episodes import EpisodeStore, bucket_storage
from dextouch.episodes.s3_bucket import Bucket
from tests.contracts.s3_server import CREDENTIALS
from tests.unit.episodes.conftest import episode_of

url, work, deadly = sys.argv[1:]
put = Bucket.put
def put_or_die(self, key, content, *, create=False):
    if key.endswith(deadly):
        os.kill(os.getpid(), signal.SIGKILL)
    return put(self, key, content, create=create)
Bucket.put = put_or_die
episode_of().write(EpisodeStore(url, CREDENTIALS | {"work_folder": str(work)}))
"""


@pytest.mark.long
@pytest.mark.parametrize("deadly", ["claim", "action/c/0/0", "/commit.json"])
def test_a_kill_during_the_upload_loses_nothing(url, store, tmp_path, deadly):
    work = tmp_path / "work"
    dead = subprocess.run([sys.executable, "-c", DYING_WRITER, url, str(work), deadly], check=False)
    assert dead.returncode == -9
    other = EpisodeStore(url, CREDENTIALS | {"work_folder": str(tmp_path / "another machine")})
    assert other.list() == []
    with pytest.raises(NotFoundError):
        other.open(EPISODE)
    made = episode_of()
    with pytest.raises(UnavailableError, match=r"waits in .* to be uploaded"):
        made.write(store)
    assert store.complete_uploads() == (("episode", EPISODE),)
    assert not any((work / ".outbox" / "episodes").iterdir())
    reader = other.open(EPISODE)
    reader.verify()
    for name, values in made.values.items():
        np.testing.assert_array_equal(reader.read(name).values, values)
    assert store.complete_uploads() == ()


def test_the_claim_comes_first_and_the_commit_record_last(store, monkeypatch, made):
    puts = []
    put = Bucket.put

    def noted(self, key, content, *, create=False):
        answer = put(self, key, content, create=create)
        puts.append((key.removeprefix(f"episodes/{EPISODE}/"), create))
        return answer

    monkeypatch.setattr(Bucket, "put", noted)
    made.write(store)
    assert puts[0] == ("claim", True)
    # Catalogs hear of it when everybody can see it.
    assert puts.pop()[0].startswith(f".changes/episodes/{EPISODE}/")
    assert puts[-1] == ("commit.json", True)
    assert [name for name, _ in puts].count("commit.json") == 1
    # Claimed once more before the commit, in case a sweep took the upload for dead.
    assert puts[-2] == ("claim", True)
    assert len(puts) == 3 + 1 + 2 * 2 * len(made.values)


def test_deleting_takes_the_commit_record_first_and_the_claim_last(store, monkeypatch, made):
    made.write(store)
    removed = []
    remove = Bucket.remove

    def noted(self, keys):
        removed.append([key.removeprefix(f"episodes/{EPISODE}/") for key in keys])
        remove(self, keys)

    monkeypatch.setattr(Bucket, "remove", noted)
    store.delete(EPISODE)
    assert removed[0] == ["commit.json"]
    assert removed[-1] == ["claim"]
    assert len(removed) == 3
    assert store.list() == []


def test_a_change_that_cannot_be_announced_is_made_all_the_same(store, bucket, monkeypatch, made):
    """What a catalog is told is no part of the change: an overloaded service costs an entry."""
    put = Bucket.put

    def overloaded(self, key, *args, **options):
        if key.startswith(".changes"):
            raise UnavailableError(f"write {key}: no answer (503 SlowDown)")
        return put(self, key, *args, **options)

    monkeypatch.setattr(Bucket, "put", overloaded)
    with capture_logs() as logs:
        made.write(store)
        store.set_review(
            EPISODE, Review(verdict="rejected", reviewer="ada", reviewed_at=datetime.now(UTC))
        )
        store.delete(EPISODE)
    assert [entry["event"] for entry in logs] == ["change_not_announced"] * 3
    assert not list(bucket.list("episodes"))


def test_what_could_not_be_uploaded_waits(s3_server, store, made):
    writer = store.writer(attributes=made.attributes)
    for descriptor in made.descriptors:
        writer.add_stream(descriptor)
        name = descriptor.name
        writer.append(name, values=made.values[name], t_ref_ns=made.stamps_ns[name])
    with s3_server.checking_credentials():
        with pytest.raises(StorageError, match=r"refused.*`complete_uploads` uploads it"):
            writer.__exit__(None, None, None)
        with pytest.raises(StorageError, match="refused"):
            store.complete_uploads()
    # A sweep takes nothing that can still be uploaded.
    assert store.sweep() == 0
    assert store.complete_uploads() == (("episode", EPISODE),)
    assert store.open(EPISODE).verify().num_arrays == 2 * len(made.values)


def begin_take(store, num_samples, recording_id="take-1"):
    writer = store.writer(
        kind="recording",
        attributes=RecordingAttributes(
            recording_id=recording_id,
            task="t",
            instruction="",
            domain="human",
            station="bench",
            streams=(FORCE,),
        ),
    )
    numbers = np.arange(num_samples)
    values = np.repeat(numbers[:, None], 2, axis=1).astype("f4")
    writer.append("force", values=values, t_host_ns=numbers)
    return writer


def test_a_take_that_waits_is_dropped_if_its_id_is_taken(s3_server, store, url, tmp_path):
    """Its upload has all of it and is finished anew, as its station then finds another id."""
    writer = begin_take(store, 17)
    with s3_server.checking_credentials(), pytest.raises(StorageError, match="refused"):
        writer.__exit__(None, None, None)
    other = EpisodeStore(url, CREDENTIALS | {"work_folder": str(tmp_path / "other")})
    with begin_take(other, 4):
        pass
    assert store.complete_uploads() == ()
    assert other.list(kind="recording") == ["take-1"]
    assert other.recording("take-1").num_samples("force") == 4
    assert not any((store.root / ".outbox" / "recordings").iterdir())


def test_one_upload_that_fails_does_not_keep_others_from_being_completed(s3_server, store, bucket):
    writers = [begin_take(store, 17, recording_id) for recording_id in ("a", "b")]
    with s3_server.checking_credentials():
        for writer in writers:
            with pytest.raises(StorageError, match="refused"):
                writer.__exit__(None, None, None)
    bucket.put("recordings/a/claim", b"0" * 64)
    with pytest.raises(UnavailableError, match="recording 'a': something else") as caught:
        store.complete_uploads()
    assert store.list(kind="recording") == ["b"]
    assert caught.value.__notes__ == ["uploaded: recording 'b'"]
    bucket.remove(["recordings/a/claim"])
    assert store.complete_uploads() == (("recording", "a"),)


@pytest.mark.parametrize("place", ["force/c/0/0", "/commit.json"])
def test_ctrl_c_during_the_upload_says_where_the_take_waits(store, monkeypatch, place):
    writer, put = begin_take(store, 17), Bucket.put

    def interrupted(self, key, content, *, create=False):
        if key.endswith(place):
            raise KeyboardInterrupt
        return put(self, key, content, create=create)

    with monkeypatch.context() as patch:
        patch.setattr(Bucket, "put", interrupted)
        with pytest.raises(KeyboardInterrupt) as caught:
            writer.__exit__(None, None, None)
    waiting = store.root / ".outbox" / "recordings" / "take-1"
    told = " ".join(getattr(caught.value, "__notes__", []))
    assert f"recording 'take-1' waits in {waiting}, `complete_uploads` uploads it" in told
    assert waiting.is_dir()
    assert store.complete_uploads() == (("recording", "take-1"),)
    assert store.recording("take-1").verify().num_arrays == 4


def test_ctrl_c_while_an_uploaded_take_is_removed_here_costs_nothing(store, monkeypatch):
    writer, rmtree = begin_take(store, 17), shutil.rmtree

    def interrupted(path, **options):
        if ".outbox" not in path.parts:
            rmtree(path, **options)
            return
        (path / "commit.json").unlink(missing_ok=True)
        rmtree(path / "force")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("dextouch.episodes.bucket_storage.shutil.rmtree", interrupted)
        with pytest.raises(KeyboardInterrupt):
            writer.__exit__(None, None, None)
    assert store.complete_uploads() == ()
    assert not any((store.root / ".outbox" / "recordings").iterdir())
    assert store.recording("take-1").verify().num_arrays == 4


def test_an_upload_under_a_foreign_claim_waits_and_overwrites_nothing(store, bucket, made):
    bucket.put(f"episodes/{EPISODE}/claim", b"0" * 64)
    bucket.put(f"episodes/{EPISODE}/action/c/0/0", b"theirs")
    with pytest.raises(UnavailableError, match="something else is uploaded or deleted"):
        made.write(store)
    assert bucket.get(f"episodes/{EPISODE}/action/c/0/0") == b"theirs"
    assert store.list() == []
    assert store.sweep() == 0
    assert sweep_orphans(bucket, now=datetime.now(UTC) + ORPHAN_AGE + timedelta(minutes=1)) == 1
    assert list(bucket.list("episodes")) == []
    assert store.complete_uploads() == (("episode", EPISODE),)
    store.open(EPISODE).verify()


def test_a_sweep_goes_on_where_deletions_are_refused(
    s3_server, store, bucket, made, tmp_path, monkeypatch
):
    made.write(store)
    store.set_review(EPISODE, None)
    claim = b"0" * 64
    for name in ("dead", "gone"):
        bucket.put(f"episodes/{name}/zarr.json", b"x")
        bucket.put(f"episodes/{name}/claim", claim)
    # Everything is old enough.
    monkeypatch.setattr(bucket_storage, "ORPHAN_AGE", -ORPHAN_AGE)
    with s3_server.refusing_deletions(f"unit/{tmp_path.name}"):
        with capture_logs() as logs:
            assert store.sweep() == 0
        with pytest.raises(StorageError, match=r"refused \(AccessDenied\); check the credentials"):
            store.delete(EPISODE)
    (warning,) = logs
    assert (warning["event"], warning["log_level"]) == ("orphans_not_removed", "warning")
    assert warning["places"] == ["episodes/dead", "episodes/gone", ".changes"]
    assert "AccessDenied" in warning["reason"]
    assert "s3:DeleteObject" in warning["advice"]
    # What uploads it could go on later.
    assert bucket.get("episodes/dead/claim") == claim
    assert store.sweep() == 2
    assert list(bucket.list("episodes/dead")) == []


def orphans(bucket, *names):
    for name in names:
        bucket.put(f"episodes/{name}/zarr.json", b"x")
    return {"now": datetime.now(UTC) + ORPHAN_AGE + timedelta(minutes=1)}


def test_a_sweep_asks_once_whether_it_may_delete(bucket, s3_server, tmp_path, monkeypatch):
    late, asked, remove = orphans(bucket, "a", "b", "c"), [], Bucket.remove

    def noted(self, keys):
        asked.extend(key for key in keys if key.endswith("/none"))
        remove(self, keys)

    monkeypatch.setattr(Bucket, "remove", noted)
    with s3_server.refusing_deletions(f"unit/{tmp_path.name}"), capture_logs() as logs:
        assert sweep_orphans(bucket, **late) == 0
    assert len(asked) == 1
    assert logs[0]["count"] == 3
    assert sweep_orphans(bucket, **late) == 3
    assert len(asked) == 2


def test_a_sweep_that_may_not_write_asks_for_no_deletions(bucket, monkeypatch):
    late = orphans(bucket, "a")

    def refuse(*_args, **_more):
        raise StorageError("write: refused (AccessDenied)")

    monkeypatch.setattr(Bucket, "put", refuse)
    with capture_logs() as logs:
        assert sweep_orphans(bucket, **late) == 0
    assert logs[0]["reason"] == "write: refused (AccessDenied)"
    assert "s3:DeleteObject" not in logs[0]["advice"]


@pytest.mark.long
def test_equal_content_of_two_writers_is_no_conflict_in_the_bucket(store, bucket, url, tmp_path):
    made = episode_of()
    made.write(store)
    commit = bucket.get(f"episodes/{EPISODE}/commit.json")
    bucket.remove([f"episodes/{EPISODE}/commit.json"])
    # As if the first one had died just before its last request.
    made.write(EpisodeStore(url, CREDENTIALS | {"work_folder": str(tmp_path / "second")}))
    assert bucket.get(f"episodes/{EPISODE}/commit.json") == commit
    # A committed group is no orphan, however old.
    assert sweep_orphans(bucket, now=datetime.now(UTC) + timedelta(days=400)) == 0
    store.open(EPISODE).verify()


def test_an_object_that_is_replaced_while_it_is_read(store, bucket, made):
    reader = made.write(store)
    key = f"episodes/{EPISODE}/camera_head/c/0/0"
    large = np.random.default_rng(1).bytes(3 * BLOCK_BYTES)
    bucket.put(key, large)
    file = reader._contents.files.source("camera_head/c/0/0")
    assert file.read(0, 10) == large[:10]
    bucket.put(key, large[::-1])
    with pytest.raises(StorageError, match=f"{key}: was deleted or replaced"):
        file.read(2 * BLOCK_BYTES, 10)
    bucket.remove([key])
    with pytest.raises(StorageError, match="open it again"):
        file.read(BLOCK_BYTES, 10)


def test_windows_need_few_requests_and_none_twice(store, url, tmp_path, monkeypatch, made):
    made.write(store)
    reader = EpisodeStore(url, CREDENTIALS | {"work_folder": str(tmp_path / "reader")}).open(
        EPISODE
    )
    requests = []
    for name in ("get", "tail", "read", "head"):
        request = getattr(Bucket, name)

        def counted(self, key, *rest, request=request):
            requests.append(key)
            return request(self, key, *rest)

        monkeypatch.setattr(Bucket, name, counted)
    first = reader.window(2, 9)
    # Values and stamps of one camera, two tactile streams and the actions; images have blocks.
    assert len(requests) <= 12
    requests.clear()
    np.testing.assert_array_equal(reader.window(2, 9).tactile_kpa, first.tactile_kpa)
    assert requests == []


def test_zarr_python_opens_it_in_the_bucket_as_it_stands(store, bucket, made):
    made.write(store)
    address, place = bucket.address, f"{bucket.address.prefix}/episodes/{EPISODE}"
    keys = S3Store(
        address.bucket,
        prefix=place,
        config=CREDENTIALS | {"endpoint": address.options.endpoint, "region": "us-east-1"},
        client_options={"allow_http": True},
    )
    group = zarr.open_group(ObjectStore(keys, read_only=True), mode="r")
    assert group.attrs["dextouch"]["task"] == made.attributes.task
    for name, values in made.values.items():
        np.testing.assert_array_equal(group[name][:], values)
        np.testing.assert_array_equal(group[f"{name}_t_ref_ns"][:], made.stamps_ns[name])


@pytest.mark.long
def test_three_hundred_episodes_are_listed(store, bucket):
    names = [f"take-{number:04d}" for number in range(300)]
    files = [
        f"episodes/{name}/{file}" for name in names for file in ("commit.json", "a/commit.json")
    ]
    orphans = [f"episodes/orphan-{number}/zarr.json" for number in range(401)]
    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(lambda key: bucket.put(key, b"x"), [*files, *orphans]))
    # More files than one answer of the service holds.
    assert len(files) + len(orphans) > 1000
    assert store.list() == names
    assert store.list(kind="recording") == []


def test_a_forked_process_is_told_how_to_start(store):
    assert store.list() == []
    receiver, sender = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            store.list()
        except UnavailableError as error:
            os.write(sender, str(error).encode())
        finally:
            os._exit(0)
    os.close(sender)
    with os.fdopen(receiver, "rb") as answer:
        assert b"start workers with 'spawn'" in answer.read()
    os.waitpid(child, 0)
