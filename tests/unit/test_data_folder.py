"""All commands share one data folder: what one writes, the next one finds without a flag."""

from pathlib import Path

import pytest

from dextouch.data_folder import data_folder
from dextouch.episodes import EpisodeStore
from dextouch.episodes.s3_bucket import parse_address
from dextouch.errors import InvalidInputError
from services.acquisition.settings import AcquisitionSettings
from services.alignment.settings import AlignmentSettings
from services.cli import main
from services.cli.up_settings import UpSettings
from services.episode_store.settings import EpisodeStoreSettings
from tests.unit.bridges.takes import write_episode


@pytest.mark.parametrize("named", [None, "elsewhere/touch"])
def test_services_keep_their_data_below_one_folder(monkeypatch, tmp_path, named):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DEXTOUCH_DATA", raising=False)
    if named is not None:
        monkeypatch.setenv("DEXTOUCH_DATA", named)
    folder = Path(named or "data")
    assert UpSettings().data == folder
    assert AcquisitionSettings().spool == folder / "spool"
    assert EpisodeStoreSettings().store_url == str(folder / "store")
    assert AlignmentSettings().store_url == str(folder / "store")
    assert parse_address("s3://b/p", {}).work_folder.parent == folder / "work"


def test_what_is_in_the_data_folder_is_listed_exported_and_imported(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DEXTOUCH_DATA", "here")
    write_episode(EpisodeStore("here/store"), "one", num_steps=3)
    assert main.main(["store", "list"]) == 0
    assert capsys.readouterr().out.startswith("one ")
    assert main.main(["export", "--format", "mcap", "one", "--to", "one.mcap"]) == 0
    monkeypatch.setenv("DEXTOUCH_DATA", "there")
    assert main.main(["import", "--format", "mcap", "one.mcap"]) == 0
    assert EpisodeStore("there/store").list() == ["one"]


@pytest.fixture
def without_variable(monkeypatch):
    """A command may set the variable; it is removed again after the test."""
    monkeypatch.setenv("DEXTOUCH_DATA", "")
    monkeypatch.delenv("DEXTOUCH_DATA")


@pytest.mark.usefixtures("without_variable")
def test_the_configuration_file_names_the_folder_of_all_commands(monkeypatch, tmp_path, capsys):
    write_episode(EpisodeStore(str(tmp_path / "lab/touch/store")), "one", num_steps=3)
    (tmp_path / "lab/dextouch.toml").write_text('data = "touch"\n[up]\nwithout = ["twin"]\n')
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    monkeypatch.setenv("DEXTOUCH_CONFIG", "../lab/dextouch.toml")
    assert main.main(["store", "list"]) == 0
    assert capsys.readouterr().out.startswith("one ")
    to = str(tmp_path / "one.mcap")
    assert main.main(["export", "--format", "mcap", "one", "--to", to]) == 0
    assert UpSettings().data.resolve() == tmp_path / "lab/touch"


def test_the_environment_comes_before_the_configuration_file(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DEXTOUCH_DATA", "here")
    (tmp_path / "dextouch.toml").write_text('data = "there"\n')
    assert main.main(["config", "show"]) == 0
    assert "# data folder: here" in capsys.readouterr().out


@pytest.mark.parametrize("value", ["3", '""'])
def test_a_data_folder_that_is_none_is_refused(monkeypatch, tmp_path, capsys, value):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dextouch.toml").write_text(f"# touch\ndata = {value}\n")
    assert main.main(["store", "list"]) == main.EXIT_REFUSED
    assert "dextouch.toml:2: data: got" in capsys.readouterr().err


def test_a_bucket_is_no_data_folder(monkeypatch, capsys):
    monkeypatch.setenv("DEXTOUCH_DATA", "s3://bucket/touch")
    with pytest.raises(InvalidInputError, match="expected a local folder"):
        data_folder()
    assert main.main(["store", "list"]) == main.EXIT_REFUSED
    assert "DEXTOUCH_DATA" in capsys.readouterr().err


def test_a_tilde_is_the_home_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("DEXTOUCH_DATA", "~/touch")
    assert data_folder() == tmp_path / "touch"
