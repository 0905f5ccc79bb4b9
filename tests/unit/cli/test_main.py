"""The command line: known words, unknown words, refusals, and the folder that is no package."""

import json
import subprocess
import sys

import pytest

from dextouch.errors import UnavailableError
from services.cli import doctor, main


def test_help_lists_every_command(capsys):
    assert main.main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(name.split()[0] in text for name in main.COMMANDS)


def test_unknown_command_names_the_valid_ones(capsys):
    assert main.main(["dance"]) == main.EXIT_USAGE
    assert "'dance'" in capsys.readouterr().err


def test_a_misspelt_inner_command_names_the_valid_ones(capsys):
    assert main.main(["station", "calibrat"]) == main.EXIT_USAGE
    told = capsys.readouterr().err
    assert (
        "unknown dextouch station command 'calibrat'; valid: bridge, calibrate, enrol, serve"
        in told
    )


def test_help_of_a_group_lists_its_commands(capsys):
    assert main.main(["station", "--help"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("usage: dextouch station COMMAND")
    assert "\n  serve " in text
    assert "\n  calibrate " in text


def test_a_result_on_standard_output_stands_alone(capsys):
    main.main(["doctor", "--json", "-"])
    told = capsys.readouterr()
    assert {"what", "found", "ok", "do", "required"} == set(json.loads(told.out)[0])
    assert "Python" in told.err


@pytest.mark.parametrize("name", sorted(main.COMMANDS))
def test_every_command_can_be_loaded_and_explains_itself(name, capsys):
    try:
        status = main.main([*name.split(), "--help"])
    except SystemExit as stop:
        status = stop.code
    assert status == 0
    assert "usage" in capsys.readouterr().out.lower()


def test_a_refusal_is_one_line_without_a_traceback(monkeypatch, capsys):
    def refuse(argv):
        raise UnavailableError("no room for this")

    monkeypatch.setattr(doctor, "main", refuse)
    assert main.main(["doctor"]) == main.EXIT_REFUSED
    assert capsys.readouterr().err == "dextouch doctor: no room for this\n"


def test_doctor_writes_its_findings(tmp_path, capsys):
    status = doctor.main(["--json", str(tmp_path / "doctor.json")])
    findings = json.loads((tmp_path / "doctor.json").read_text())
    assert status == (0 if all(f["ok"] or not f["required"] for f in findings) else 1)
    assert len(capsys.readouterr().out.splitlines()) == len(findings)


def test_names_in_lists_of_commands_stand_apart(capsys):
    main.main(["--help"])
    lines = capsys.readouterr().out.splitlines()
    assert {name for name in main.COMMANDS if " " not in name} <= {
        line.split()[0] for line in lines if line.startswith("  ")
    }


def test_the_nouns_cannot_be_imported_twice():
    answer = subprocess.run(
        [sys.executable, "-c", "import shared.dextouch"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == 1
    assert "import `dextouch`" in answer.stderr
