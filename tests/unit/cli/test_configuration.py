"""The configuration file: precedence, refusals with lines, `config show` and `config example`."""

import importlib
import json
import pkgutil
import re
import tomllib
from pathlib import Path

import pytest

import services
from dextouch.errors import InvalidInputError
from dextouch.serving import CommandSettings, ServiceSettings, load_settings, section_of
from dextouch.worlds import WorldServiceSettings
from services.cli import configuration
from services.cli.main import main
from services.dashboard.settings import DashboardSettings
from services.twin.settings import TwinServiceSettings
from services.world_model.paper_settings import TrainCommand

KEY = "a-key-of-some-length"
FILE = f"""\
# Of this desk.
[dashboard]
port = 8080
station = "desk 3"
upstream_key = "{KEY}"

[[dashboard.api_keys]]
name = "desk"
key = "{KEY}"
scopes = ["operate"]

[twin]
state_url = "redis://me:{KEY}@redis/1"

[twin.limits]
max_chunks = 7
ttl_s = 60
"""


# Of settings without a default.
GIVEN = {
    "episodes": "somewhere",
    "init": "some.safetensors",
    "seeds": "1:2",
    "real": {"url": "http://localhost:1", "world": "twin"},
}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def write(folder):
    return lambda text, name="dextouch.toml": (folder / name).write_text(text)


def test_flags_come_before_the_environment_before_the_file_before_defaults(write, monkeypatch):
    write('[dashboard]\nport = 1\nstation = "file"\nsession_hours = 2\nstation_period_s = 3\n')
    monkeypatch.setenv("DEXTOUCH_DASHBOARD_PORT", "11")
    monkeypatch.setenv("DEXTOUCH_DASHBOARD_STATION", "environment")
    found = load_settings(DashboardSettings, ["--port", "21"])
    assert (found.port, found.station, found.session_hours) == (21, "environment", 2.0)
    assert found.list_period_s == 2.0


def test_nested_settings_of_several_sources_are_merged(write, monkeypatch):
    write(FILE)
    monkeypatch.setenv("DEXTOUCH_TWIN_LIMITS__TTL_S", "70")
    found = load_settings(TwinServiceSettings, ["--limits.max-rollouts", "5"]).limits
    assert (found.max_chunks, found.ttl_s, found.max_rollouts) == (7, 70.0, 5)


def test_a_named_file_is_read_in_place_of_the_one_in_the_folder(write, monkeypatch):
    write("[dashboard]\nport = 1\n")
    write("[dashboard]\nport = 2\n", "other.toml")
    assert load_settings(DashboardSettings, []).port == 1
    monkeypatch.setenv("DEXTOUCH_CONFIG", "other.toml")
    assert load_settings(DashboardSettings, []).port == 2
    monkeypatch.setenv("DEXTOUCH_CONFIG", "missing.toml")
    with pytest.raises(InvalidInputError, match=r"DEXTOUCH_CONFIG: got 'missing\.toml'"):
        load_settings(DashboardSettings, [])


def test_a_preset_is_named_by_the_file_and_yields_to_it(write):
    write('[world_model_train]\nepisodes = "a"\npreset = "paper"\n')
    of_preset = load_settings(TrainCommand, [])
    assert of_preset.preset == "paper"
    write('[world_model_train]\nepisodes = "a"\npreset = "paper"\nnetwork = {sampling_steps = 3}\n')
    assert load_settings(TrainCommand, []).network.sampling_steps == 3
    assert of_preset.network.sampling_steps == 8


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[dashboard]\nport = 1\nporrt = 2\n", r"porrt.*dextouch\.toml:3 \[dashboard\] porrt"),
        ("[dashboard]\nport = 'x'\n", r"port.*whole number.*dextouch\.toml:2 \[dashboard\] port"),
        (FILE.replace("scopes", "scope"), r"dextouch\.toml:10 \[dashboard\] api_keys\.0\.scope"),
        ("[dashboard]\nport = \n", r"dextouch\.toml: cannot be read as TOML: .*line 2"),
        ("port = 3\n[dashboard]\n", r"dextouch\.toml:1: port stands outside of a section"),
    ],
)
def test_mistakes_name_their_place(write, text, message):
    write(text)
    with pytest.raises(InvalidInputError, match=message) as caught:
        load_settings(DashboardSettings, [])
    assert KEY not in caught.value.message


def test_every_command_refuses_an_unknown_section(write, capsys):
    write("[dashboard]\nport = 1\n\n[dashbord]\nport = 2\n")
    assert main(["doctor"]) == 3
    assert "dextouch.toml:4: unknown section [dashbord]" in capsys.readouterr().err


def test_variables_that_set_nothing_are_named_when_a_command_starts(monkeypatch, capsys):
    for variable in (
        "DEXTOUCH_EPISODE_STORE_PROT",
        "DEXTOUCH_EPISODE_STORE_PORT",
        "DEXTOUCH_EPISODE_STORE_UPLOAD_LIMITS__NO",
        "DEXTOUCH_DASHBOARD_PROT",
        "DEXTOUCH_DATA",
    ):
        monkeypatch.setenv(variable, "x")
    assert main(["store", "serve"]) == 3
    shown = capsys.readouterr().err.splitlines()
    warnings = [line for line in shown if "warning" in line]
    assert warnings == [
        "dextouch store serve: warning: DEXTOUCH_EPISODE_STORE_PROT sets nothing: there is no such "
        "setting; did you mean DEXTOUCH_EPISODE_STORE_PORT?",
        "dextouch store serve: warning: DEXTOUCH_EPISODE_STORE_UPLOAD_LIMITS__NO sets nothing: "
        "there is no such setting; see dextouch config show episode_store",
    ]


def test_a_section_is_not_taken_for_a_setting_of_one_whose_name_it_begins_with():
    given = ["DEXTOUCH_WORLD_MODEL_TRAIN_SEED", "DEXTOUCH_WORLD_MODEL_NO", "dextouch_twin_port"]
    (problem,) = configuration.unknown_variables("world_model", given)
    assert problem.startswith("DEXTOUCH_WORLD_MODEL_NO sets nothing")
    assert not configuration.unknown_variables("twin", given)


def test_variables_of_the_chosen_form_are_looked_at_and_aliases_are_none(monkeypatch, capsys):
    monkeypatch.setenv("DEXTOUCH_WORLD_MODEL_TRAIN_SEEED", "1")
    assert main(["train", "world-model", "--preset", "tiny"]) == 3
    assert "did you mean DEXTOUCH_WORLD_MODEL_TRAIN_SEED?" in capsys.readouterr().err
    (problem,) = configuration.unknown_variables("up", ["DEXTOUCH_UP_JSON_PATH"])
    assert problem.endswith("see dextouch config show up")


@pytest.mark.long
def test_show_says_where_each_setting_comes_from(write, monkeypatch, capsys):
    write(FILE)
    monkeypatch.setenv("DEXTOUCH_DASHBOARD_STATION", "desk 4")
    monkeypatch.setenv("DEXTOUCH_TWIN_LIMITS__TTL_S", "70")
    assert main(["config", "show", "--json", "shown.json"]) == 0
    shown = capsys.readouterr().out
    sections = json.loads(Path("shown.json").read_text())["sections"]
    assert sections["dashboard"]["port"] == {"value": 8080, "origin": "dextouch.toml:3"}
    station = {"value": "desk 4", "origin": "DEXTOUCH_DASHBOARD_STATION"}
    assert sections["dashboard"]["station"] == station
    assert sections["twin"]["limits.max_chunks"]["origin"] == "dextouch.toml:16"
    assert sections["twin"]["limits.ttl_s"] == {
        "value": "70",
        "origin": "DEXTOUCH_TWIN_LIMITS__TTL_S",
    }
    assert "session_hours" not in sections["dashboard"]
    assert re.search(r'^upstream_key = "\*\*\*" +# dextouch\.toml:5$', shown, re.M)
    assert 'state_url = "redis://***@redis/1"' in shown
    assert KEY not in shown


def test_show_of_one_section_has_its_defaults(write, capsys):
    write(FILE)
    assert main(["config", "show", "dashboard"]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"^session_hours = 12\.0 +# default$", shown, re.M)
    assert KEY not in shown


def test_show_refuses_what_the_command_would_refuse(write, capsys):
    write("[twin]\nlimits = {max_chunks = 0}\n")
    assert main(["config", "show"]) == 3
    assert "dextouch.toml:2 [twin] limits.max_chunks" in capsys.readouterr().err


def settings_classes():
    """All settings classes of commands, wherever they are."""
    for found in pkgutil.walk_packages(services.__path__, "services."):
        if found.name.rpartition(".")[2] in {"app", "up", "serving"} or found.name.endswith(
            "settings"
        ):
            importlib.import_module(found.name)
    todo = [CommandSettings]
    while todo:
        kind = todo.pop()
        todo += kind.__subclasses__()
        if kind not in {CommandSettings, ServiceSettings, WorldServiceSettings}:
            yield kind


def test_every_settings_class_has_a_section():
    found = {
        section_of(kind): f"{kind.__module__.removeprefix('services.')}:{kind.__name__}"
        for kind in settings_classes()
        if kind.__module__.startswith("services.")
    }
    assert found == dict(configuration.SECTIONS)


@pytest.mark.parametrize("section", configuration.SECTIONS)
def test_the_example_changes_nothing(section, write):
    kind = configuration.settings_class(section)
    text = configuration.example([section])
    assert set(tomllib.loads(text)) == {section}
    # With every line that has a default.
    opened = re.sub(r"^# (\[.+\])$", r"\1", text, flags=re.M)
    opened = re.sub(r"^#(\w+ = (?!…).*)$", r"\1", opened, flags=re.M)
    write(opened)
    given = {name: GIVEN[name] for name, field in kind.model_fields.items() if field.is_required()}
    if "episodes" in given and kind.model_fields["episodes"].annotation is not str:
        given["episodes"] = ("somewhere",)
    written = kind(**given)
    write("")
    assert written == kind(**given)


def test_an_example_is_not_written_over_a_file(write, capsys):
    write(FILE)
    assert main(["config", "example", "--output", "dextouch.toml"]) == 3
    assert "dextouch.toml" in capsys.readouterr().err
