"""The whole demo as a user starts it: exit 0, and every figure that is promised in its report."""

import json
import subprocess
import sys

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.system]


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
    for take in report["takes"].values():
        for device in take["devices"]:
            assert device["ledger_lost"] == device["counted_lost"]
            assert device["corrupted"] == device["counted_crc_errors"]
            assert device["sent"] == device["counted_packets"]
