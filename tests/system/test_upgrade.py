"""Stations and stores of the last release beside those of today: nothing is lost, either way."""

import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from dextouch.episodes import EpisodeStore
from tests.integration.test_station_enrolment import save_a_take, until, upload_of
from tests.system.compose_processes import free_port
from tests.unit.episode_store.episodes import write_take

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
# Until there is a release: the last commit whose stores have format v2.
BEFORE_V3 = "63796f1bddd0eed5d40c66130e2bf49e00e80f29"
TODAY = (ROOT, ROOT / "shared")


def git(*words, **options):
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, check=False, **options)


@pytest.fixture(scope="module")
def last_release(tmp_path_factory):
    """Folder in which the wheel of the last release is installed."""
    tag = git("describe", "--tags", "--abbrev=0", text=True).stdout.strip()
    archive = git("archive", tag or BEFORE_V3)
    if archive.returncode != 0:
        pytest.skip(f"the history lacks {tag or BEFORE_V3}: git fetch --unshallow")
    source, installed = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("installed")
    subprocess.run(["tar", "x", "-C", str(source)], input=archive.stdout, check=True)
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(source / "dist")]
    subprocess.run(build, cwd=source, check=True, capture_output=True)
    (wheel,) = (source / "dist").glob("*.whl")
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index"]
    subprocess.run([*pip, "--target", str(installed), str(wheel)], check=True, capture_output=True)
    return (installed,)


def command(release, *words):
    """Arguments of a process of a release: its command, and its environment."""
    module = "dextouch_services.cli.main"
    kept = {name: value for name, value in os.environ.items() if not name.startswith("DEXTOUCH_")}
    path = os.pathsep.join(map(str, release))
    return [sys.executable, "-m", module, *words], kept | {"PYTHONPATH": path}


def run(release, *words, status=0):
    arguments, environment = command(release, *words)
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == status, done.stderr
    return done.stdout + done.stderr


@contextmanager
def serving(release, folder, *words):
    """A service of a release as a process; its address."""
    port = free_port()
    arguments, environment = command(release, *words, "--port", str(port))
    url = f"http://127.0.0.1:{port}"

    def is_ready():
        assert process.poll() is None, log.read_text()
        try:
            return httpx.get(f"{url}/readyz", trust_env=False).status_code == 200
        except httpx.HTTPError:
            return False

    folder.mkdir(exist_ok=True)
    log = folder / f"{words[0]}.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            arguments, env=environment, cwd=folder, stderr=output, stdout=output
        )
    try:
        until(is_ready, f"{words} did not start")
        yield url
    finally:
        process.terminate()
        process.wait(60)


def test_the_last_release_refuses_a_store_of_today_by_its_version(last_release, tmp_path):
    store = EpisodeStore(tmp_path / "store")
    write_take(store, "take")
    said = run(last_release, "store", "show", "take-aligned", "--store", str(store.root), status=3)
    assert "format" in said
    assert "version 3" in said or "v3" in said
    assert "Traceback" not in said
    # It changes nothing, and the store is whole.
    assert "DAMAGED" not in run(TODAY, "store", "verify", "--store", str(store.root))


@pytest.mark.parametrize("is_station_new", [False, True])
def test_stations_and_stores_of_two_releases(last_release, tmp_path, is_station_new):
    of_station, of_store = (TODAY, last_release) if is_station_new else (last_release, TODAY)
    place, spool = tmp_path / "store", tmp_path / "spool"
    station = ("station", "serve", "--mock", "--spool", str(spool), "--upload-period-s", "0.2")
    with serving(of_store, tmp_path, "store", "serve", "--store-url", str(place)) as url:
        arguments = (*station, "--episode-store-url", url)
        with (
            serving(of_station, tmp_path, *arguments) as address,
            httpx.Client(base_url=address, timeout=60) as desk,
        ):
            take = save_a_take(desk)
            found = until(
                lambda: (one := upload_of(desk, take))["uploaded"] or one["error"], "no upload"
            )
    if is_station_new and EpisodeStore(place).exists(take, kind="recording"):
        # The way back: a backup by the new release is a store of the old one.
        run(TODAY, "store", "backup", str(tmp_path / "backup"), "--store", str(place))
        assert "whole" in run(last_release, "store", "verify", "--store", str(tmp_path / "backup"))
    if found is not True:
        # An older store may refuse the take, which then waits.
        assert (spool / take / "recording.json").is_file()
    # The store is updated, as is whoever reads it; the station may follow later.
    with (
        serving(TODAY, tmp_path, "store", "serve", "--store-url", str(place)) as url,
        serving(of_station, tmp_path, *station, "--episode-store-url", url) as address,
        httpx.Client(base_url=address, timeout=60) as desk,
    ):
        until(lambda: upload_of(desk, take)["uploaded"], "not sent to the new store")
        newer = save_a_take(desk)
        until(lambda: upload_of(desk, newer)["uploaded"], "not uploaded")
    said = run(TODAY, "store", "verify", "--store", str(place))
    assert said.count("  whole  recording") == 2
