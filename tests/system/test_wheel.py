"""The wheel, installed outside the checkout, runs `dextouch demo` and `dextouch up` by itself."""

import json
import os
import re
import signal
import subprocess
import sys
import time
import zipfile
from importlib import metadata
from pathlib import Path

import httpx
import pytest

from tests.system.wheel_environment import MAX_WHEEL_BYTES, NAME, ROOT, build, own_packages
from tests.unit.test_licences import PROJECT, vendored_licences

pytestmark = [pytest.mark.slow, pytest.mark.system]

SERVICES = {
    *("episode_store", "alignment", "acquisition", "twin", "world_model", "studies", "dashboard")
}
# Of a machine that is busy with other things; the solver may be compiled first.
READY_LIMIT_S = 900
# A program of a user, with one mistake.
CLIENT = """\
from pathlib import Path

import numpy as np

from dextouch.clients import RolloutClient
from dextouch.episodes import EpisodeStore
from dextouch_services.evaluation.settings import DEFAULT_PROBE

store = EpisodeStore(Path("data/store"))
images: np.ndarray = store.open("take").images("camera_head")
probe: Path = DEFAULT_PROBE
with RolloutClient("http://127.0.0.1:8086") as client:
    print(client, images, probe)
wrong: int = store.list()
"""
IMPORT_ALL = """
import importlib, json, pkgutil
import dextouch, dextouch_services
absent = []
for package in (dextouch, dextouch_services):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            absent.append([module.name, error.name])
print(json.dumps(absent))
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """What `pip install 'dextouch-wm[all]'` would give."""
    environment = build(tmp_path_factory.mktemp("wheel"), ("all",))
    yield environment
    assert environment.opened_in_the_checkout() == []


def files_below(folder, installed_as):
    found = (path for path in folder.rglob("*") if path.is_file())
    return {str(installed_as / path.relative_to(folder)) for path in found if path.suffix != ".pyc"}


def test_the_wheel_holds_every_file_of_both_packages(installed):
    found = {}
    for wheel in (installed.wheel, installed.weights):
        with zipfile.ZipFile(wheel) as opened:
            found[wheel] = {name for name in opened.namelist() if ".dist-info/" not in name}
    names = found[installed.wheel]
    share = next(Path(name).parts[0] for name in names if ".data/" in name) / Path("data/share")
    services = files_below(ROOT / "services", Path("dextouch_services"))
    weights = {name for name in services if name.endswith(".safetensors")}
    assert found[installed.weights] == weights
    assert len(weights) == 5
    # Clients and stations have no use for weights.
    assert installed.wheel.stat().st_size < MAX_WHEEL_BYTES
    assert names == (
        (services - weights)
        | files_below(ROOT / "shared/dextouch", Path("dextouch"))
        | files_below(ROOT / "deploy", share / "dextouch/deploy")
        | files_below(ROOT / "docs", share / "dextouch/docs")
        | {str(share / "dextouch/docker-compose.yml")}
    )
    for path in own_packages(installed).values():
        assert path.startswith(str(installed.site_packages))


def test_types_reach_those_who_check_theirs(installed):
    client = installed.folder / "client.py"
    client.write_text(CLIENT)
    checker = [sys.executable, "-m", "mypy", "--cache-dir", os.devnull, "--python-executable"]
    done = subprocess.run(
        [*checker, str(installed.bin / "python"), str(client)],
        cwd=installed.folder,
        env={name: v for name, v in os.environ.items() if name not in {"PYTHONPATH", "MYPYPATH"}},
        text=True,
        capture_output=True,
        check=False,
    )
    wrong = re.findall(r"client\.py:(\d+): error: .*\[([a-z-]+)\]", done.stdout)
    expected = 1 + CLIENT.splitlines().index("wrong: int = store.list()")
    assert wrong == [(str(expected), "assignment")], done.stdout


def test_licences_of_what_others_wrote_are_in_the_wheel(installed):
    (own,) = metadata.distributions(name=NAME, path=[str(installed.site_packages)])
    told = own.metadata
    assert told["License-Expression"] == PROJECT["license"]
    wanted = told.get_all("License-File")
    assert sorted(wanted) == sorted({"LICENSE", *vendored_licences()})
    folder = next(installed.site_packages.glob("dextouch_wm-*.dist-info")) / "licenses"
    for name in wanted:
        assert (folder / name).read_bytes() == (ROOT / name).read_bytes()


def test_the_version_is_told(installed):
    version = installed.run("dextouch", "--version").strip()
    (own,) = metadata.distributions(name=NAME, path=[str(installed.site_packages)])
    assert version == f"dextouch {own.version}"


def test_the_extras_name_what_every_module_imports(installed):
    absent = json.loads(installed.run("python", "-c", IMPORT_ALL, limit_s=600))
    # The viewer and Ray have extras of their own, which `all` leaves out.
    apart = [
        ["dextouch.bridges.import_rerun", "rerun"],
        ["dextouch.bridges.rerun", "rerun"],
        ["dextouch_services.pipelines.ray_serve", "ray"],
    ]
    assert sorted(absent) == apart


def test_the_machine_is_judged(installed):
    done = json.loads(installed.run("dextouch", "doctor", "--json", "-"))
    assert done


def wait_until_ready(client, name, url):
    """Alignment says 503 while its solver is compiled."""
    last = time.monotonic() + READY_LIMIT_S
    while not (answer := client.get(f"{url}/readyz")).is_success:
        assert answer.status_code == 503, name
        assert time.monotonic() < last, f"{name}: {answer.text}"
        time.sleep(0.5)


def test_all_services_answer_and_stop(installed):
    urls_path = installed.folder / "urls.json"
    running = installed.start("dextouch", "up", "--json", str(urls_path))
    try:
        while not urls_path.exists() or not urls_path.read_text().endswith("\n"):
            assert running.poll() is None, running.communicate()[1][-4000:]
            time.sleep(0.1)
        urls = json.loads(urls_path.read_text())
        with httpx.Client(trust_env=False, timeout=60) as client:
            for name, url in urls.items():
                wait_until_ready(client, name, url)
            page = client.get(urls["dashboard"])
            style = client.get(f"{urls['dashboard']}/static/style.css")
            guide = client.get(f"{urls['dashboard']}/help/dashboard")
    finally:
        running.send_signal(signal.SIGINT)
        _, errors = running.communicate(timeout=120)
    assert running.returncode == 0, errors[-4000:]
    assert set(urls) == SERVICES
    assert page.is_success
    assert style.is_success
    assert guide.is_success
    assert "Recordings and episodes" in guide.text


def test_the_demo_ends_well(installed):
    installed.run("dextouch", "demo", "--seeds", "1", limit_s=1800)
    report = json.loads((installed.folder / "demo/report.json").read_text())
    assert report["errors"]["taxel_iou"] >= 0.98
    assert (installed.folder / "demo/report.html").stat().st_size > 20_000
