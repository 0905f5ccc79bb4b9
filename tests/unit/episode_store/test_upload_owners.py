"""Uploads and the keys that send them: each key rules over its own uploads only."""

import asyncio
import os
from contextlib import contextmanager

import pytest
from pydantic import SecretStr

from dextouch.clients import EpisodeStoreClient
from dextouch.episodes import EpisodeStore
from dextouch.errors import AccessDeniedError, ConflictError, InvalidInputError, StorageError
from dextouch.schemas import status_of
from dextouch.serving import AccessControl
from dextouch.serving.keys import ApiKey
from services.episode_store.app import create_app
from services.episode_store.keys import Enrolments
from tests.unit.episode_store.conftest import InProcess

COUNTS = {"glove_left": 1, "wrist_left": 0}
WRITING = ("store_write", "store_read")
KEYS = {
    "station-1": {"scopes": WRITING},
    "station-2": {"scopes": WRITING},
    "bound": {"scopes": WRITING, "station": "desk_9"},
    "cleaner": {"scopes": ("store_expire", "store_read")},
}


def secret_of(name):
    return f"key-of-{name}-0123456789"


def api_keys(wanted):
    return tuple(
        ApiKey(**({"name": name, "key": SecretStr(secret_of(name))} | how))
        for name, how in wanted.items()
    )


@pytest.fixture
def serve(settings, tmp_path):
    """A store with keys, and the enrolled stations `bench` and `desk_2`; a client of each key."""
    path = tmp_path / "enrolments.json"
    enrolled = {}

    @contextmanager
    def started(wanted=KEYS):
        if not enrolled:
            enrolments = Enrolments(path)
            enrolments.connect(AccessControl(api_keys(KEYS)))
            for station in ("bench", "desk_2"):
                token = enrolments.issue(station, by="admin").token
                enrolled[station] = enrolments.exchange(token, client="10.0.0.1").key
        app = create_app(
            settings.model_copy(update={"api_keys": api_keys(wanted), "enrolments": path})
        )
        clients = []

        def client(name):
            key = enrolled.get(name, secret_of(name))
            clients.append(EpisodeStoreClient("http://localhost", key, transport=InProcess(app)))
            return clients[-1]

        with asyncio.Runner() as runner:
            lifespan = app.router.lifespan_context(app)
            runner.run(lifespan.__aenter__())
            try:
                yield client
            finally:
                runner.run(lifespan.__aexit__(None, None, None))
                for one in clients:
                    one.close()

    return started


def begin(client, attributes, batch_of):
    client.create(attributes)
    client.send_batch("take-1", attributes.streams[0], batch_of(0, 5), number=0)


def refusals(client, attributes, batch_of):
    """How each request of another's upload `take-1` is refused: the class, and the reason."""
    requests = (
        lambda: client.create(attributes),
        lambda: client.send_batch("take-1", attributes.streams[0], batch_of(5, 5), number=1),
        lambda: client.finish("take-1", COUNTS),
    )
    found = []
    for request in requests:
        with pytest.raises((AccessDeniedError, ConflictError)) as refused:
            request()
        found.append((type(refused.value), refused.value.details["reason"]))
        # 401 would tell a station to look for another key.
        is_taken = refused.value.details["reason"] == "id_taken"
        assert status_of(refused.value) == (409 if is_taken else 403)
    return found


TAKEN = (ConflictError, "id_taken")
OTHER_KEY, OTHER_STATION = (AccessDeniedError, "other_key"), (AccessDeniedError, "other_station")


@pytest.mark.long
@pytest.mark.parametrize(
    ("owner", "intruder", "expected"),
    [
        ("bench", "desk_2", [OTHER_STATION] * 3),
        ("bench", "bound", [OTHER_STATION] * 3),
        ("bench", "station-1", [TAKEN, OTHER_KEY, OTHER_KEY]),
        ("station-1", "station-2", [TAKEN, OTHER_KEY, OTHER_KEY]),
        ("station-1", "desk_2", [OTHER_STATION] * 3),
    ],
)
def test_an_upload_belongs_to_the_key_that_began_it(
    serve, settings, attributes, batch_of, owner, intruder, expected
):
    with serve() as client:
        begin(client(owner), attributes, batch_of)
        assert refusals(client(intruder), attributes, batch_of) == expected
    # As after a restart of the store.
    with serve() as client:
        assert refusals(client(intruder), attributes, batch_of) == expected
        assert client(owner).create(attributes).next_batch == COUNTS
        client(owner).finish("take-1", COUNTS)
    assert EpisodeStore(settings.store_url).recording("take-1").num_samples("glove_left") == 5


@pytest.mark.parametrize("key", ["desk_2", "bound"])
def test_a_key_of_a_station_begins_nothing_in_another_name(serve, settings, attributes, key):
    with serve() as client:
        with pytest.raises(AccessDeniedError, match="got takes of station 'bench'"):
            client(key).create(attributes)
        assert client("cleaner").uploads().uploads == ()
        own = {"desk_2": "desk_2", "bound": "desk_9"}[key]
        mine = attributes.model_copy(update={"station": own})
        assert client(key).create(mine).state == "open"
        # The id is taken, whatever the other says of it.
        with pytest.raises(ConflictError):
            client("bench").create(attributes)
    assert not EpisodeStore(settings.store_url).exists("take-1", kind="recording")


def test_the_status_of_an_upload_is_for_its_key(serve, attributes, batch_of):
    with serve() as client:
        begin(client("station-1"), attributes, batch_of)
        assert client("station-1").status("take-1").next_batch == COUNTS
        for other, reason in (("station-2", "other_key"), ("bound", "other_station")):
            with pytest.raises(AccessDeniedError) as refused:
                client(other).status("take-1")
            assert refused.value.details["reason"] == reason
        client("station-1").finish("take-1", COUNTS)
        # A finished recording is for everyone who reads, but not for a key of another station.
        assert client("station-2").status("take-1").state == "finished"
        for request in (
            lambda key: key.status("take-1"),
            lambda key: key.finish("take-1", COUNTS),
        ):
            with pytest.raises(AccessDeniedError):
                request(client("bound"))


def test_an_upload_outlives_the_rotation_of_its_key(serve, attributes, batch_of):
    with serve() as client:
        begin(client("station-1"), attributes, batch_of)
    # Another secret under the same name.
    secret = secret_of("of-this-year")
    changed = KEYS | {"station-1": {"scopes": WRITING, "key": SecretStr(secret)}}
    with serve(changed) as client:
        assert client("of-this-year").create(attributes).next_batch == COUNTS
        with pytest.raises(AccessDeniedError, match="unknown key"):
            client("station-1").create(attributes)
        # Enrolled meanwhile, in place of a key of the settings.
        assert client("bench").create(attributes).next_batch == COUNTS
        assert client("bench").finish("take-1", COUNTS).state == "finished"


@pytest.mark.long
def test_uploads_begun_without_keys_go_on_with_keys(serve, attributes, batch_of):
    with serve({}) as client:
        begin(client("nobody"), attributes, batch_of)
    with serve() as client:
        with pytest.raises(AccessDeniedError):
            client("desk_2").create(attributes)
        assert client("station-2").create(attributes).next_batch == COUNTS
        client("bench").finish("take-1", COUNTS)


def test_without_keys_every_upload_is_open(serve, attributes, batch_of):
    with serve() as client:
        begin(client("station-1"), attributes, batch_of)
    with serve({}) as client:
        assert client("nobody").create(attributes).next_batch == COUNTS
        assert client("nobody").finish("take-1", COUNTS).state == "finished"


def age(settings, seconds):
    """Let the upload `take-1` have been idle for so long."""
    folder = EpisodeStore(settings.store_url).root / ".uploads" / "take-1"
    for path in (*folder.iterdir(), folder):
        changed = path.stat().st_mtime - seconds
        os.utime(path, (changed, changed))


@pytest.mark.long
def test_only_a_key_with_the_scope_drops_uploads_and_only_old_ones(
    serve, settings, attributes, batch_of
):
    with serve() as client:
        begin(client("bench"), attributes, batch_of)
        for key in ("bench", "desk_2", "station-1", "bound"):
            with pytest.raises(AccessDeniedError) as refused:
                client(key).expire_uploads(idle_s=86_400.0)
            assert refused.value.details == {"reason": "missing_scope", "scope": "store_expire"}
        cleaner = client("cleaner")
        for idle_s in (0.0, 1.0, 599.0):
            with pytest.raises(InvalidInputError, match="600"):
                cleaner.expire_uploads(idle_s=idle_s)
        assert cleaner.expire_uploads(idle_s=600.0).uploads == ()
        assert [one.recording_id for one in cleaner.uploads().uploads] == ["take-1"]
        age(settings, 700)
        assert [u.recording_id for u in cleaner.expire_uploads(idle_s=600.0).uploads] == ["take-1"]
        assert client("bench").create(attributes).next_batch == dict.fromkeys(COUNTS, 0)


def test_a_damaged_name_of_the_sender_is_no_permission(serve, settings, attributes, batch_of):
    with serve() as client:
        begin(client("station-1"), attributes, batch_of)
        folder = EpisodeStore(settings.store_url).root / ".uploads" / "take-1"
        (folder / "sender.json").write_text("{")
        with pytest.raises(StorageError, match=r"sender.json is damaged"):
            client("station-2").create(attributes)
