"""`dextouch station bridge`: its flags, refusals, and how it ends."""

import json
import signal
import subprocess
import sys

import pytest

from dextouch.errors import InvalidInputError
from services.acquisition.sdk_bridges.bridge import OUR_AXES, hello
from services.acquisition.sdk_bridges.command_line import PORTS, bridge_parser, build_source, main
from services.acquisition.sdk_bridges.lighthouse_trackers import LibsurviveTrackers, OpenVrTrackers
from services.acquisition.sdk_bridges.lsl_stream import LslStream
from services.acquisition.sdk_bridges.manus_gloves import ManusGloves
from services.acquisition.sdk_bridges.openxr_hands import OpenXrHands


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


@pytest.mark.parametrize(
    ("devices", "found"),
    [("A=left --device A=right", "device A"), ("A=left --device B=left", "place left")],
)
@pytest.mark.parametrize("source", ["openvr", "libsurvive"])
def test_devices_and_places_are_named_once(source, devices, found):
    with pytest.raises(InvalidInputError, match=f"got the {found} more than once"):
        source_of(f"{source} --device {devices}")


def test_any_number_of_devices_have_no_place():
    source_of("openvr --device A=none --device B=none")


@pytest.mark.parametrize("source", ["openvr", "libsurvive"])
def test_a_serial_number_that_is_too_long_is_refused(source):
    with pytest.raises(InvalidInputError, match=r"--device: serial_number: .* 128 characters"):
        source_of(f"{source} --device {'A' * 129}=left")


def test_a_hello_of_a_long_path_is_cut_and_a_long_outlet_refused():
    about = {"kind": "numbers", "frame": OUR_AXES, "channels": 1, "software": "/" * 1000}
    device = {"index": 0, "serial_number": "EMG", "source": "none"}
    assert hello(**about, devices=(device,)).software == "/" * 256
    with pytest.raises(InvalidInputError, match=r"devices.0.serial_number: .* 128 characters"):
        hello(**about, devices=(device | {"serial_number": "E" * 129},))


@pytest.mark.parametrize("port", ["65536", "99999", "-1", "x", "1.5"])
def test_a_port_is_one_of_tcp(port, capsys):
    with pytest.raises(SystemExit):
        bridge_parser().parse_args(["lsl", f"--port={port}"])
    assert f"got '{port}', expected a port of 0 … 65535" in capsys.readouterr().err


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
