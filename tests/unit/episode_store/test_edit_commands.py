"""`dextouch store trim, relabel, merge, note`: what each writes, says and refuses."""

import json

import pytest

from dextouch.episodes import EpisodeStore, maintenance
from dextouch.schemas import MAX_NOTES, ItemNotes
from services.cli.main import main
from tests.unit.episode_store.episodes import write_episode, write_recording


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


@pytest.fixture
def run(store, tmp_path, capsys):
    def call(*words, into="--store", status=0):
        path = tmp_path / "result.json"
        path.unlink(missing_ok=True)
        assert main(["store", *words, into, str(store.root), "--json", str(path)]) == status
        out, err = capsys.readouterr()
        return out + err, json.loads(path.read_text()) if path.exists() else None

    return call


def test_trim_by_seconds_or_steps(run, store):
    write_episode(store, "a", num_steps=30)
    said, result = run("trim", "a", "--from", "1", "--dry-run")
    assert "a  would become a-trimmed-1  trim --steps 15 30\n" in said
    assert result["num_samples"]["action"] == 15
    assert store.list() == ["a"]
    said, result = run(
        "trim", "a", "--steps", "3", "20", "--outcome", "keep", "--as", "b", "--keep"
    )
    assert "the source is superseded" in said
    assert result["sha256"] == store.open("b").content_sha256
    said, _ = run("verify")
    assert "DAMAGED" not in said
    said, _ = run("trim", "b", "--to", "0.5", "--outcome", "failure")
    assert "the source is in the trash" in said
    assert store.list() == ["a", "b-trimmed-1"]
    assert run("show", "b-trimmed-1")[0].count("made from episode") == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trim", "a"], "expected --from, --to or --steps"),
        (["trim", "a", "--steps", "1", "5", "--to", "1"], "--steps goes without"),
        (["trim", "take", "--steps", "1", "5"], "with episodes only"),
        (["trim", "nobody", "--to", "1"], "'nobody': not in the store"),
        (["trim", "a", "--to", "0.4"], "say it with --outcome"),
        (["trim", "a", "--from", "0.5", "--to", "0.5"], "got a span from 0.5 to 0.5 s"),
        (["relabel", "a"], "nothing changes"),
        (
            ["relabel", "a", "--task", "x" * 129, "--outcome", "keep"],
            "task: Value should have at most 128",
        ),
        (["relabel", "a", "--instruction", "up\x1b[2J"], "U+001B"),
        (["relabel", "a", "a", "--task", "x", "--as", "b"], "--as names one item"),
        (["note", "a", "--text", "x"], "expected --from"),
        (["note", "a", "--from", "9", "--text", "x"], "expected one within 0.000 … 0.533 s"),
        (["note", "a", "--from", "0.2", "--to", "0.1", "--text", "x"], "got the range 0.200 … 0.1"),
        (["note", "a", "--from", "0", "--text", "x" * 1001], "at most 1000 characters"),
        (["note", "a", "--remove", "4"], "its notes are none"),
    ],
)
def test_what_cannot_be_done_is_explained_and_changes_nothing(run, store, words, message):
    write_episode(store, "a")
    write_recording(store, "take")
    said, _ = run(*words, status=3)
    assert message in said
    assert (store.list(), store.list(kind="recording")) == (["a"], ["take"])
    assert store.trash_list() == []


def test_relabel_several_of_which_one_is_refused(run, store):
    write_episode(store, "a")
    write_episode(store, "b", instruction="up")
    words = ("relabel", "a", "b", "nobody", "--instruction", "up")
    said, result = run(*words, status=1)
    assert "b  refused  episode 'b': nothing changes" in said
    assert [one["id"] for one in result["edited"]] == ["a-relabelled-1"]
    assert sorted(result["refused"]) == ["b", "nobody"]
    assert store.list() == ["a-relabelled-1", "b"]


def test_merge_from_the_command_line(run, store, tmp_path):
    other = EpisodeStore(tmp_path / "other")
    write_episode(other, "a")
    write_episode(store, "a", seed=4)
    said, _ = run("merge", str(other.root), into="--into", status=1)
    assert "a  episode  refused" in said
    said, result = run("merge", str(other.root), "--rename", into="--into")
    assert "a  episode  copied  as a-merged-1" in said
    assert (result["copied"], result["refused"]) == (1, 0)
    said, _ = run("merge", str(tmp_path / "typo"), into="--into", status=3)
    assert "no such folder" in said


def test_notes_are_added_listed_removed_and_go_with_the_item(run, store, tmp_path):
    write_episode(store, "a", num_steps=30)
    run("note", "a", "--from", "1", "--to", "1.5", "--text", "it slips", "--author", "p-7")
    said, result = run("note", "a", "--from", "0.2", "--text", "earlier")
    assert said.splitlines() == [
        "2  0.200 … 0.200 s  -  earlier",
        "1  1.000 … 1.500 s  p-7  it slips",
    ]
    assert [one["number"] for one in result["notes"]] == [2, 1]
    sha256 = store.open("a").content_sha256
    run("verify", "a")
    store.delete("a")
    store.restore("a")
    assert len(store.notes("a").notes) == 2
    assert store.open("a").content_sha256 == sha256
    # A person's name goes, what was said stays.
    request = maintenance.DeletionRequest(operator="p-7")
    receipt = maintenance.delete_for_good(store.root, request, tmp_path / "receipt.json")
    assert (receipt.deleted, receipt.complete) == ((), True)
    assert [(one.author, one.text) for one in store.notes("a").notes] == [
        (None, "earlier"),
        (None, "it slips"),
    ]
    assert len(run("note", "a", "--remove", "2")[1]["notes"]) == 1
    run("note", "a", "--remove", "1")
    assert not (store.root / "episodes/a/notes.json").exists()


def test_notes_of_a_recording_count_from_its_start_and_are_limited(run, store):
    write_recording(store, "take", started_t_host_ns=-500_000_000)
    run("note", "take", "--from", "0.6", "--to", "0.8", "--text", "x")
    (note,) = store.notes("take", kind="recording").notes
    assert (note.start_ns, note.stop_ns) == (100_000_000, 300_000_000)
    many = [note.model_copy(update={"number": k}) for k in range(1, MAX_NOTES + 1)]
    store.change_notes("take", lambda _: ItemNotes(notes=tuple(many)), kind="recording")
    said, _ = run("note", "take", "--from", "0.6", "--text", "x", status=3)
    assert "remove one first" in said
