"""Folders of services that are gone, another one, or read-only."""

import os
import shutil
import subprocess

import pytest
from fastapi import APIRouter
from httpx import ASGITransport, AsyncClient

from dextouch.errors import UnavailableError
from dextouch.serving import ServedFolder, ServiceSettings, create_service_app


@pytest.fixture
def read_only(tmp_path):
    """A folder that this user cannot write, with a file in it; as root on a disk of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if os.getuid():
        (folder / "kept").write_text("kept")
        folder.chmod(0o555)
        yield folder
        folder.chmod(0o755)
        return
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("mounting is not allowed here")
    (folder / "kept").write_text("kept")
    try:
        subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_folder_is_created_once_and_never_anew(tmp_path):
    folder = ServedFolder(tmp_path / "a" / "store", "store folder")
    assert folder.problem(writing=True) is None
    folder.open()
    assert folder.path.is_dir()
    folder.check(writing=True)
    shutil.rmtree(tmp_path / "a")
    with pytest.raises(UnavailableError, match=f"store folder {folder.path}: is gone"):
        folder.check(writing=False)
    with pytest.raises(UnavailableError, match="not created anew"):
        folder.open()
    assert not folder.path.exists()


def test_another_folder_of_the_same_name_is_refused_until_the_first_is_back(tmp_path):
    folder = ServedFolder(tmp_path / "store", "store folder")
    folder.open()
    folder.path.rename(tmp_path / "away")
    folder.path.mkdir()
    with pytest.raises(UnavailableError, match="is another folder than at the start"):
        folder.check(writing=False)
    folder.path.rmdir()
    (tmp_path / "away").rename(folder.path)
    folder.check(writing=True)


def test_a_folder_that_is_only_read_may_come_later_but_not_go(tmp_path):
    folder = ServedFolder(tmp_path / "studies", "folder of studies", is_written=False)
    folder.open()
    assert not folder.path.exists()
    folder.check(writing=True)
    folder.path.mkdir()
    folder.check(writing=True)
    folder.path.rmdir()
    with pytest.raises(UnavailableError, match="is gone"):
        folder.check(writing=False)


def test_a_folder_that_cannot_be_created_is_told_until_it_is_there(tmp_path):
    (tmp_path / "file").write_text("")
    folder = ServedFolder(tmp_path / "file" / "store", "store folder")
    with pytest.raises(UnavailableError, match="cannot be created"):
        folder.open()
    with pytest.raises(UnavailableError, match="cannot be created"):
        folder.check(writing=False)
    (tmp_path / "file").unlink()
    folder.open()
    folder.check(writing=True)


async def test_a_read_only_folder_can_be_read_but_the_service_is_not_ready(read_only):
    folder = ServedFolder(read_only, "store folder")
    router = APIRouter()

    @router.get("/kept")
    def kept() -> str:
        return (read_only / "kept").read_text()

    @router.post("/kept")
    def keep() -> str:
        return "never answered"

    app = create_service_app(
        name="test", settings=ServiceSettings(), routers=[router], folders=[folder]
    )
    async with (
        app.router.lifespan_context(app),
        AsyncClient(transport=ASGITransport(app), base_url="http://localhost") as client,
    ):
        assert (await client.get("/kept")).json() == "kept"
        refused = await client.post("/kept")
        assert (refused.status_code, refused.json()["title"]) == (503, "Unavailable")
        assert f"store folder {read_only}: is read-only" in refused.json()["detail"]
        ready = await client.get("/readyz")
        assert ready.status_code == 503
        assert f"{read_only}: is read-only" in ready.json()["waiting_for"][0]
        assert (await client.get("/healthz")).status_code == 200
