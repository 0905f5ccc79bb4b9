"""`python -m benchmarks acquisition`: one short run as users start it, and its tables and verdicts.

What a run says of speed is not judged here: that is for a quiet machine.
"""

import json
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.acquisition import benchmark
from benchmarks.acquisition.benchmark import requirements
from benchmarks.acquisition.decoders import (
    Judgement,
    Line,
    count_split_differences,
    decode_all,
    disturb,
    judge,
    make_families,
    make_talks,
)
from benchmarks.command import stage_parser, usage
from benchmarks.figures import Figure
from benchmarks.stages import STAGES
from dextouch.errors import InvalidInputError

FAMILIES = {family.name: family for family in make_families()}
BAD_LINE = Line(bit_error_rate=1e-4, byte_loss_rate=1e-5)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A quick run in a process of its own, as shape checks must not be timed."""
    folder = tmp_path_factory.mktemp("bench")
    command = [sys.executable, "-m", "benchmarks", "acquisition", "--quick"]
    options = ["--packets", "600", "--seconds", "0.3", "--json", str(folder / "figures.json")]
    done = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout, json.loads((folder / "figures.json").read_text())


@pytest.mark.slow
def test_a_quick_run_measures_everything(run):
    text, figures = run
    found = {(j["family"], j["way"]): j for j in figures["judgements"]}
    assert len(found) == 6
    assert len(figures["us_a_packet"]) == 18
    assert all(all(value > 0 for value in row["rounds"]) for row in figures["us_a_packet"])
    assert len(figures["drivers"]) == 11
    assert all(min(row["us_a_packet"]) > 0 for row in figures["drivers"])
    (eight,) = figures["eight_gloves"]
    assert eight["errors"] == 0
    assert eight["packets"] > 0
    assert [row["way"] for row in figures["starved"]] == ["process", "thread", "process"]
    assert all(row["sent"] > 0 for row in figures["starved"])
    assert all(r["figure"] is not None for r in figures["requirements"])
    assert "wrong packets of 600, dextouch" in text


@pytest.mark.parametrize("name", ["dextouch", "wuji"])
def test_checksums_hold_where_rivals_do_not(name):
    family = FAMILIES[name]
    found = {j.way: j for j in judge(family, BAD_LINE, 400, seed=3)}
    ours = found.pop("ours")
    assert (ours.wrong, ours.collateral) == (0, 0)
    assert ours.delivered == ours.sent - ours.touched < ours.sent
    assert all(rival.wrong > ours.touched / 2 for rival in found.values())


def test_without_checksum_the_rest_is_still_held_back():
    family = FAMILIES["justfloat"]
    found = {j.way: j for j in judge(family, BAD_LINE, 400, seed=3)}
    assert found["ours"].wrong < found["tail alone"].wrong


@pytest.mark.parametrize("name", FAMILIES)
def test_cutting_changes_nothing(name):
    assert count_split_differences(FAMILIES[name], BAD_LINE, 6, seed=1) == 0


def test_the_line_tells_what_it_touched():
    packets = [bytes([number]) * 100 for number in range(200)]
    rng = np.random.default_rng(0)
    data, touched = disturb(packets, Line(1e-3, 0.0), rng)
    got = [data[at : at + 100] for at in range(0, len(data), 100)]
    assert [a != b for a, b in zip(got, packets, strict=True)] == touched.tolist()
    assert 0 < touched.sum() < 200
    shorter, lost = disturb(packets, Line(0.0, 1e-3), rng)
    assert len(shorter) < len(data)
    assert lost.any()


def test_verdicts_say_what_failed():
    found = [
        Judgement("dextouch", "ours", 90, 3, 87, 0, 0),
        Judgement("wuji", "ours", 100, 3, 97, 1, 0),
    ]
    names = ("glove wuji", "glove dextouch", "robot state")
    times = (Figure.of([16.0]), Figure.of([15.0]), Figure.of([99.0]))
    drivers = dict(zip(names, times, strict=True))
    table = {
        r.what: r.verdict() for r in requirements(found, drivers, {"wuji": 0}, Figure.of([2.0]))
    }
    assert table == {
        "wrong packets of 90, dextouch": "pass",
        "packets lost untouched of 90, dextouch": "pass",
        "wrong packets of 100, wuji": "FAIL",
        "packets lost untouched of 100, wuji": "pass",
        "ways of cutting the stream that change the packets, all families": "pass",
        "processor time a packet, glove wuji": "FAIL",
        "processor time a packet, glove dextouch": "pass",
        "core a stream, 8 gloves at 60 Hz on terminals": "FAIL",
    }


@pytest.mark.parametrize("words", [["--packets", "4"], ["--rounds", "0"], ["--seconds", "0"]])
def test_options_that_mean_nothing_are_refused(words, tmp_path):
    parser = stage_parser("acquisition")
    benchmark.add_options(parser)
    options = parser.parse_args(words)
    with pytest.raises(InvalidInputError, match=words[0]):
        benchmark.measure(options, tmp_path, pytest.fail)


@pytest.mark.parametrize("talk", make_talks(seed=1), ids=lambda talk: talk.name)
def test_every_driver_takes_each_packet_that_is_timed(talk):
    decoder = talk.decoder()
    for read in talk.greeting:
        assert decoder.decode(read, 0) == {}
    num_streams = len(decoder.descriptors)
    # Packets without a mark at their start need one to find their place.
    num_packets = len(talk.packets) - ("justfloat" in talk.name)
    assert decode_all(talk, decoder) == num_streams * num_packets
    assert talk.packet_bytes == np.mean([len(b"".join(packet)) for packet in talk.packets])


def test_help_keeps_names_and_words_apart():
    lines = usage().splitlines()
    assert all(
        any(line.split() == [name, *entry.does.split()] for line in lines)
        for name, entry in STAGES.items()
    )
