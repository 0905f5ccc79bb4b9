"""`python -m benchmarks starts`: one start of a task under every camera, and with other sizes."""

from contextlib import nullcontext

import numpy as np
import pytest

from benchmarks import starts
from benchmarks.command import stage_parser
from dextouch.errors import InvalidInputError


def options(*arguments):
    parser = stage_parser("starts")
    starts.add_options(parser)
    return parser.parse_args(list(arguments))


def bar(*_):
    return nullcontext(lambda _: None)


def test_a_quick_run_reads_every_kind_of_start(tmp_path):
    report = starts.measure(options("--starts", "1", "--tasks", "stand_bottle"), tmp_path, bar)
    errors, outcomes = report.tables
    kinds = [row[0] for row in errors.rows]
    assert kinds[: len(starts.CAMERAS)] == list(starts.CAMERAS)
    assert {"at step 32", "at step 64", "objects 0.8 times as wide"} < set(kinds)
    assert all(np.isfinite(values).all() for values in report.data["stand_bottle"].values())
    by_name = {row[0]: row[1:] for row in outcomes.rows}
    assert by_name["stand_bottle: as in the twin"][0] == "1.00"
    assert by_name["stand_bottle: objects 0.8 times as wide"][0] == "0.00"


def test_no_start_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="at least 1"):
        starts.measure(options("--starts", "0"), tmp_path, bar)


def test_a_known_shift_moves_the_picture_as_the_matrix_says():
    image = np.zeros((8, 8, 3))
    image[3, 4] = 1.0
    draw = np.random.default_rng(0)
    camera = starts.CAMERAS["shifted by a known pixel"]
    right, down = camera.shift_px
    moved = starts.shifted((camera.change(image, draw) * 255).astype(np.uint8), camera.shift_px)
    assert np.argwhere(moved[..., 0]).tolist() == [[3 + down, 4 + right]]
