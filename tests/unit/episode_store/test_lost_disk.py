"""A store whose disk is full, gone, emptied or replaced while the service runs."""

import shutil
import subprocess

import pytest

from dextouch.episodes import EpisodeStore
from dextouch.errors import NotFoundError, StorageFullError, UnavailableError
from services.episode_store import intake
from services.episode_store.app import create_app
from tests.unit.episode_store.episodes import write_episode


@pytest.fixture
def full_disk(tmp_path):
    """Fills the disk of the store to its last byte; it has a megabyte."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "none", str(folder)]
    try:
        is_mounted = subprocess.run(mount, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        is_mounted = False
    if not is_mounted:
        pytest.skip("mounting is not allowed here")

    def fill():
        with (folder / "filler").open("wb", buffering=0) as file:
            try:
                while file.write(bytes(1024)):
                    pass
            except OSError:
                pass

    yield folder, fill
    subprocess.run(["umount", "-l", str(folder)], check=True)


def send_some(client, attributes, batch_of):
    client.create(attributes)
    glove, wrist = attributes.streams
    client.send_batch("take-1", glove, batch_of(0, 20), number=0)
    client.send_batch("take-1", glove, batch_of(20, 20), number=1)
    return glove, {glove.name: 2, wrist.name: 0}


@pytest.mark.parametrize("is_reopened", [False, True])
def test_what_was_acknowledged_is_acknowledged_again_on_a_full_disk(
    start, attributes, batch_of, full_disk, is_reopened
):
    folder, fill = full_disk
    settings = {"store_url": str(folder / "store"), "min_free_bytes": 0, "max_open_uploads": 1}
    client = start(**settings)
    glove, num_batches = send_some(client, attributes, batch_of)
    if is_reopened:
        # Its files are closed for those of another upload.
        client.create(attributes.model_copy(update={"recording_id": "take-0"}))
    fill()
    assert client.create(attributes).state == "open"
    for number in (0, 1):
        receipt = client.send_batch("take-1", glove, batch_of(20 * number, 20), number=number)
        assert (receipt.replayed, receipt.num_samples) == (True, 20)
    with pytest.raises(StorageFullError):
        client.send_batch("take-1", glove, batch_of(40, 20), number=2)
    (folder / "filler").unlink()
    client.finish("take-1", num_batches)
    fill()
    assert client.finish("take-1", num_batches).state == "finished"
    assert client.create(attributes).state == "finished"


@pytest.mark.parametrize("limit", ["min_free_bytes", "quota_bytes_per_station"])
def test_a_repeat_needs_neither_reserve_nor_quota(start, attributes, batch_of, limit, monkeypatch):
    # Room to begin an upload, and for four batches of 15 kB.
    client = start(**{limit: 70_000})
    glove, num_batches = send_some(client, attributes, batch_of)
    for number in (2, 3):
        client.send_batch("take-1", glove, batch_of(20 * number, 20), number=number)
    if limit == "min_free_bytes":
        monkeypatch.setattr(intake, "free_bytes_of", lambda _: 10)
    with pytest.raises(StorageFullError):
        client.send_batch("take-1", glove, batch_of(80, 20), number=4)
    with pytest.raises(StorageFullError):
        client.create(attributes.model_copy(update={"recording_id": "take-2"}))
    assert client.send_batch("take-1", glove, batch_of(0, 20), number=0).replayed
    assert client.create(attributes).state == "open"
    if limit == "min_free_bytes":
        with pytest.raises(StorageFullError):
            client.finish("take-1", num_batches)


def empty(folder):
    shutil.rmtree(folder)
    folder.mkdir()


LOSSES = {"gone": shutil.rmtree, "another folder": empty}


@pytest.mark.parametrize(("told", "lose"), LOSSES.items(), ids=LOSSES)
def test_a_lost_store_is_refused_by_name_and_not_created_anew(
    start, settings, attributes, batch_of, told, lose
):
    folder = EpisodeStore(settings.store_url).root
    write_episode(EpisodeStore(folder), "e-1")
    client = start()
    glove, num_batches = send_some(client, attributes, batch_of)
    lose(folder)
    for use in (
        lambda: client.send_batch("take-1", glove, batch_of(40, 20), number=2),
        lambda: client.send_batch("take-1", glove, batch_of(0, 20), number=0),
        lambda: client.create(attributes.model_copy(update={"recording_id": "take-2"})),
        lambda: client.finish("take-1", num_batches),
        lambda: client.episode("e-1"),
        lambda: client.window("e-1", 0, 1),
        client.episodes,
    ):
        with pytest.raises(UnavailableError, match=f"store folder {folder}: is {told}"):
            use()
    assert not folder.exists() or not list(folder.iterdir())


def test_a_batch_of_an_upload_that_was_removed_is_not_acknowledged(
    start, settings, attributes, batch_of
):
    client = start()
    glove, _ = send_some(client, attributes, batch_of)
    shutil.rmtree(EpisodeStore(settings.store_url).root / ".uploads")
    with pytest.raises(NotFoundError):
        client.send_batch("take-1", glove, batch_of(40, 20), number=2)
    assert client.create(attributes).next_batch["glove_left"] == 0
    assert not client.send_batch("take-1", glove, batch_of(0, 20), number=0).replayed


async def test_a_read_only_store_starts_but_is_not_ready(settings, read_only_disk):
    write_episode(EpisodeStore(read_only_disk.folder / "store"), "e-1")
    read_only_disk.close()
    app = create_app(
        settings.model_copy(update={"store_url": str(read_only_disk.folder / "store")})
    )
    async with app.router.lifespan_context(app):
        answer = await read_only_disk.get(app, "/readyz")
        assert answer.status_code == 503
        assert "is read-only" in answer.json()["waiting_for"][0]
        assert (await read_only_disk.get(app, "/v1/episodes/e-1")).status_code == 200


@pytest.fixture
def read_only_disk(full_disk):
    from httpx import ASGITransport, AsyncClient

    class Disk:
        folder = full_disk[0]

        def close(self):
            subprocess.run(["mount", "-o", "remount,ro", str(self.folder)], check=True)

        async def get(self, app, path):
            transport = ASGITransport(app)
            async with AsyncClient(transport=transport, base_url="http://localhost") as client:
                return await client.get(path)

    return Disk()
