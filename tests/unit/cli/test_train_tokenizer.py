"""`dextouch train tokenizer`: its result as JSON and its picture of learning curves."""

import json
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from dextouch.errors import NotFoundError
from services.pipelines import train_tokenizer
from services.world_model import command_line
from services.world_model.checkpoints import read_tokenizer
from services.world_model.training.tokenizer_trainer import TactileHands

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture
def hands(monkeypatch):
    """Two scenes with random contacts instead of a store."""
    rng = np.random.default_rng(0)
    kpa = (rng.random((60, 320)) * 30 * (rng.random((60, 320)) < 0.2)).astype(np.float32)
    split = (TactileHands(kpa[:40], ("a/1",), "0"), TactileHands(kpa[40:], ("a/2",), "1"))
    module = "services.world_model.training.tokenizer_trainer.load_hands"
    monkeypatch.setattr(module, lambda *_, **__: split)


def _run(folder, name, *flags):
    output = folder / f"{name}.safetensors"
    given = ["--episodes=store", f"--tokenizer={name}", f"--output={output}", *flags]
    assert train_tokenizer.main(given) == 0
    return output


@pytest.mark.long
@pytest.mark.usefixtures("hands")
def test_curves_of_several_tokenizers_are_drawn_side_by_side(tmp_path, capsys):
    short = ("--max-steps=3", "--num-evaluations=3", "--tactile-channels=12")
    first = _run(tmp_path, "split_hands", *short, f"--json={tmp_path / 'result.json'}")
    result = json.loads((tmp_path / "result.json").read_text())
    stored = read_tokenizer(first)
    assert result["digest"] == stored.digest
    assert [point["step"] for point in result["curve"]] == [0, 1, 2, 3]
    assert result["ms_per_1000_hands"] > 0
    assert (
        command_line.run_show([f"--checkpoint={first}", f"--json={tmp_path / 'shown.json'}"]) == 0
    )
    shown = json.loads((tmp_path / "shown.json").read_text())[0]
    assert (shown["form"], shown["digest"]) == ("tactile tokenizer", stored.digest)
    axes = _run(tmp_path, "principal_axes")
    picture = tmp_path / "curves.svg"
    _run(tmp_path, "grid", *short, f"--picture={picture}", f"--beside={first},{axes}")
    assert "Contact-IoU" not in capsys.readouterr().err
    root = ET.fromstring(picture.read_text())  # noqa: S314
    error, iou = root.findall(f"{SVG}svg")
    assert float(iou.attrib["x"]) == float(error.attrib["width"])
    for chart in (error, iou):
        lines = chart.findall(f"{SVG}polyline")
        assert [line[0].text for line in lines] == [
            "split_hands, seed 0", "principal_axes, seed 0", "grid, seed 0"
        ]  # fmt: skip
        assert [len(line.attrib["points"].split()) for line in lines] == [4, 2, 4]
        assert [line.attrib["class"] for line in lines] == ["curve s0", "curve s1", "curve s2"]
        assert ["stroke-dasharray" in line.attrib for line in lines] == [False, True, False]
    # Contact-IoU is drawn from low to high: points of the curve keep their order of heights.
    heights = [float(p.split(",")[1]) for p in lines[0].attrib["points"].split()]
    values = [point["contact_iou"] for point in result["curve"]]
    assert (
        np.argsort(values, kind="stable").tolist()
        == np.argsort(-np.array(heights), kind="stable").tolist()
    )
    assert [text.text for text in root.findall(f"{SVG}text")] == [
        "split_hands", "principal_axes", "grid"
    ]  # fmt: skip


@pytest.mark.usefixtures("hands")
def test_a_missing_file_to_draw_fails_before_training(tmp_path):
    with pytest.raises(NotFoundError, match="nowhere"):
        _run(tmp_path, "grid", f"--beside={tmp_path / 'nowhere.safetensors'}")
    assert not (tmp_path / "grid.safetensors").exists()
