"""`dextouch station bridge`: its flags, refusals, and how it ends."""

import json
import signal
import subprocess
import sys

import pytest

from dextouch.errors import InvalidInputError
from services.acquisition.sdk_bridges.command_line import build_source, main
from services.acquisition.sdk_bridges.libsurvive_trackers import LibsurviveTrackers
from services.acquisition.sdk_bridges.lsl_stream import LslStream
from services.acquisition.sdk_bridges.manus_gloves import ManusGloves
from services.acquisition.sdk_bridges.openvr_trackers import OpenVrTrackers
from services.acquisition.sdk_bridges.openxr_hands import OpenXrHands
from services.acquisition.sdk_bridges.parser import PORTS, bridge_parser


def source_of(line):
    return build_source(bridge_parser().parse_args(line.split()))


@pytest.mark.parametrize(
    ("line", "kind"),
    [
        ("openvr --device LHR-1=left --origin raw", OpenVrTrackers),
        ("libsurvive --device T20=none --argument=--simulator", LibsurviveTrackers),
        ("manus --library /opt/libManusSDK_Integrated.so", ManusGloves),
        ("openxr --side right --side left", OpenXrHands),
        ("lsl --stream EMG --by type", LslStream),
    ],
)
def test_each_source_is_built(line, kind):
    assert type(source_of(line)) is kind


def test_every_source_has_its_own_port():
    assert len(set(PORTS.values())) == len(PORTS)
    for source, port in PORTS.items():
        assert bridge_parser().parse_args([source]).port == port


@pytest.mark.parametrize("source", ["openvr", "libsurvive"])
def test_trackers_must_be_named(source):
    with pytest.raises(InvalidInputError, match="--device LHR-1A2B3C4D=left"):
        source_of(source)


def test_an_outlet_must_be_named():
    with pytest.raises(InvalidInputError, match="--stream"):
        source_of("lsl")


@pytest.mark.parametrize("place", ["LHR-1", "=left", "LHR-1=", "LHR-1=elbow"])
def test_a_place_is_one_that_packets_know(place, capsys):
    with pytest.raises(SystemExit):
        bridge_parser().parse_args(["openvr", "--device", place])
    assert (
        "expected SERIAL=PLACE with a place of left, right, head, none" in capsys.readouterr().err
    )


def test_what_is_there_is_listed(monkeypatch, capsys):
    monkeypatch.setattr(LslStream, "present", lambda _: ["EMG (8 channels)"])
    assert main(["lsl", "--list", "--json", "-"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("EMG (8 channels)\n")
    assert json.loads(shown.partition("\n")[2]) == ["EMG (8 channels)"]


@pytest.mark.long
@pytest.mark.system
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_with_a_summary(compiled, connect, number):
    path, _ = compiled("libsurvive")
    command = [sys.executable, "-m", "services.cli.main", "station", "bridge", "libsurvive"]
    options = ["--device", "T20=left", "--library", str(path), "--port", "0", "--json", "-"]
    with subprocess.Popen(
        [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        # With --json - the lines for people are on standard error.
        first = process.stderr.readline()
        port = int(first.rpartition(":")[2])
        driver = connect(kind="pose_tracker", stream="wrist_left", port=port)
        assert driver.decoder.hello.devices[0].serial_number == "T20"
        process.send_signal(number)
        out, err = process.communicate(timeout=30)
    assert process.returncode == 0
    assert "T20: 0 samples sent" in err
    summary = json.loads(out)
    assert summary["sent"] == {"T20": 0}
    assert summary["seconds"] > 0
