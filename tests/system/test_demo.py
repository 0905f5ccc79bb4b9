"""The README's first commands as a user types them, and every figure that the demo promises."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import httpx
import pytest

from tests.integration.tutorial_page import readme_commands

pytestmark = [pytest.mark.slow, pytest.mark.system]

# The commands without what `make` installs.
QUICK = {("make", "demo"): ["dextouch", "demo", "--seeds", "1"], ("make", "test"): []}
DEXTOUCH = [sys.executable, "-m", "services.cli.main"]


def in_folder(folder, words, **more):
    environment = {name: v for name, v in os.environ.items() if name != "DEXTOUCH_DATA"}
    return subprocess.Popen(
        [*DEXTOUCH, *words], cwd=folder, text=True, env=environment, stdout=subprocess.PIPE, **more
    )


def episodes_of_up(folder):
    """What the store service of `dextouch up` lists once all services answer."""
    urls = folder / "urls.json"
    urls.unlink(missing_ok=True)
    running = in_folder(folder, ["up", "--json", str(urls)])
    try:
        while not urls.exists() or not urls.read_text().endswith("\n"):
            assert running.poll() is None, "dextouch up ended by itself"
            time.sleep(0.1)
        address = json.loads(urls.read_text())["episode_store"]
        listed = httpx.get(f"{address}/v1/episodes", trust_env=False, timeout=60).json()
    finally:
        running.send_signal(signal.SIGINT)
        running.communicate()
    assert running.returncode == 0
    return [episode["episode_id"] for episode in listed["episodes"]]


def test_commands_of_the_readme_run_in_order_and_twice(tmp_path):
    wanted = readme_commands(QUICK)
    assert ["dextouch", "up"] in wanted
    for _ in range(2):
        listed = []
        for _, *words in wanted:
            if words == ["up"]:
                assert episodes_of_up(tmp_path) == listed
                continue
            running = in_folder(tmp_path, words)
            out, _ = running.communicate(timeout=900)
            assert running.returncode == 0, words
            if words == ["store", "list"]:
                rows = [line.split() for line in out.splitlines()]
                listed = [row[0] for row in rows if row[1] == "episode"]
        names = [re.fullmatch(r"demo-(human|robot)-[0-9a-f]{12}", name)[1] for name in listed]
        assert names == ["human", "robot"]
    report = json.loads((tmp_path / "demo" / "report.json").read_text())
    robot = report["takes"]["robot"]["episode_id"]
    export = in_folder(tmp_path, ["export", "--format", "mcap", "--to", "demo/robot.mcap", robot])
    export.communicate(timeout=120)
    assert (export.returncode, robot in listed) == (0, True)


def test_demo_ends_well_and_keeps_its_promises(tmp_path):
    answer = subprocess.run(
        [sys.executable, "-m", "services.cli.main", "demo", "--seeds", "2"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
    )
    assert answer.returncode == 0, answer.stderr[-4000:]
    report = json.loads((tmp_path / "demo" / "report.json").read_text())
    assert (tmp_path / "demo" / "report.html").stat().st_size > 20_000
    errors, model = report["errors"], report["world_model"]
    assert max(errors["clock_rms_ms"].values()) <= 1.0
    assert errors["taxel_iou"] >= 0.98
    assert errors["wrist_error_mm"] <= 1.0
    assert errors["wrist_error_deg"] <= 0.1
    assert errors["taxel_mae_kpa"] < 0.1
    assert errors["fingertip_error_mm"] < 3.0
    assert model["psnr"] > model["psnr_copy"]
    assert model["tactile_mse"] < min(model["tactile_mse_copy"], model["tactile_mse_zero"])
    assert {row["task"] for row in report["policies"]} == set(report["agreement"])
    assert len(report["agreement"]) >= 2
    assert all(found["num_policies"] >= 8 for found in report["agreement"].values())
    assert all(len(row["imagined_interval"]) == 2 for row in report["policies"])
    for take in report["takes"].values():
        for device in take["devices"]:
            assert device["ledger_lost"] == device["counted_lost"]
            assert device["corrupted"] == device["counted_crc_errors"]
            assert device["sent"] == device["counted_packets"]
