"""`dextouch store`: what each word says, writes and answers."""

import argparse
import io
import json
import os
import shutil

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.episodes.spool import SpoolWriter
from dextouch.schemas import EpisodeAttributes, LineageEntry, RecordingAttributes
from dextouch.streams import SampleBatch, StreamDescriptor
from services.cli.main import main
from services.episode_store import command_line
from services.episode_store.command_line import readable_size, table
from services.episode_store.parser import seconds_of

IDENTITY_ROWS = [[float(i == j) for j in range(4)] for i in range(4)]
FORCE = StreamDescriptor(
    name="force", kind="scalar", shape=(2,), dtype="float32", unit="N", nominal_rate_hz=10
)
CAMERA = StreamDescriptor(
    name="camera_head",
    kind="image",
    shape=(16, 16, 3),
    dtype="uint8",
    unit="h264",
    nominal_rate_hz=30,
)


def write_episode(store, episode_id, **changes):
    fields = {
        "episode_id": episode_id,
        "task": "stand_bottle",
        "instruction": "",
        "domain": "robot",
        "origin": "twin",
        "anchor": dict.fromkeys(
            ("T_world_wrist_left", "T_world_wrist_right", "T_world_camera_head"), IDENTITY_ROWS
        ),
        "K_head": [[4, 0, 2], [0, 4, 2], [0, 0, 1]],
        "streams": [FORCE.model_dump(), CAMERA.model_dump()],
    }
    attributes = EpisodeAttributes.model_validate(fields | changes)
    stamps = np.array([0, 1, 2, 5, 6]) * 10**8
    images = np.full((5, 16, 16, 3), 80, np.uint8)
    with store.writer(attributes=attributes) as writer:
        writer.append("force", values=np.ones((5, 2), "f4"), t_ref_ns=stamps)
        writer.append("camera_head", values=images, t_ref_ns=np.arange(5) * 33_333_333)


def recording_attributes(recording_id, operator):
    return RecordingAttributes(
        recording_id=recording_id,
        task="stand_bottle",
        instruction="",
        domain="human",
        station="bench",
        operator=operator,
        streams=(FORCE,),
    )


def write_recording(store, recording_id, operator="op-1"):
    attributes = recording_attributes(recording_id, operator)
    with store.writer(kind="recording", attributes=attributes) as writer:
        writer.append("force", values=np.ones((20, 2), "f4"), t_host_ns=np.arange(20))


@pytest.fixture
def store(tmp_path):
    store = EpisodeStore(tmp_path / "store")
    write_episode(store, "e-1")
    write_recording(store, "r-1")
    return store


@pytest.fixture
def word(store, monkeypatch, capsys):
    """Run a word; its status and what it said."""
    # It sets up logging for its process, which here is that of all tests.
    monkeypatch.setattr(command_line, "configure_logging", lambda **_: None)

    def run(*words):
        status = main(["store", words[0], "--store", str(store.root), *words[1:]])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run


def shard_of(store, *names):
    folder = store.root.joinpath(*names) / "c"
    return next(path for path in folder.rglob("*") if path.is_file())


def flip(path, place=3):
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)


def test_show_is_a_table(store, word):
    status, out, _ = word("show", "e-1")
    lines = out.splitlines()
    assert status == 0
    assert lines[0] == "episode e-1  stand_bottle  robot"
    head = ["stream", "Hz", "samples", "gaps", "size", "per", "hour", "codec", "encoder"]
    assert lines[2].split() == head
    assert lines[3].split()[:4] == ["force", "10", "5", "1"]
    assert lines[4].split()[:4] == ["camera_head", "30", "5", "0"]
    assert "h264   libx264 ultrafast" in lines[4]
    assert lines[5].endswith("B per hour")
    assert store.open("e-1").content_sha256 in lines[6]
    result = json.loads(word("show", "r-1", "--json", "-")[1])
    size = sum(
        shard_of(store, "recordings", "r-1", name).stat().st_size
        for name in ("force", "force_t_host_ns", "force_t_device_ns", "force_sequence")
    )
    assert result["streams"]["force"]["num_bytes"] == size
    # 20 samples at its rate.
    hours = 20 / result["streams"]["force"]["rate_hz"] / 3600
    assert result["streams"]["force"]["bytes_per_hour"] == round(size / hours)


EPISODE_ROW = "e-1  episode  stand_bottle  robot  twin  0 steps  not judged\n"
RECORDING_ROW = "r-1  recording  stand_bottle  human  20 samples  not judged\n"


def test_list_shows_episodes_and_recordings(word, tmp_path):
    assert word("list") == (0, EPISODE_ROW + RECORDING_ROW, "")
    assert word("list", "--kind", "episode")[1] == EPISODE_ROW
    assert word("list", "--kind", "recording")[1] == RECORDING_ROW
    assert word("list", "--domain", "human")[1] == RECORDING_ROW
    # Recordings have no origin.
    assert word("list", "--origin", "twin")[1] == EPISODE_ROW
    assert word("list", "--task", "stand_bottle")[1] == EPISODE_ROW + RECORDING_ROW
    told = "nothing matches, of 1 episode and 1 recording\n"
    assert word("list", "--task", "stack_bowls")[1] == told
    told = "nothing matches, of 1 recording\n"
    assert word("list", "--task", "stack_bowls", "--kind", "recording")[1] == told
    result = json.loads(word("list", "--json", "-")[1])
    assert [row["episode_id"] for row in result["episodes"]] == ["e-1"]
    assert [row["recording_id"] for row in result["recordings"]] == ["r-1"]
    assert result["num_matching"] == 2
    assert "recordings" not in json.loads(word("list", "--kind", "episode", "--json", "-")[1])


def test_a_store_of_recordings_alone_is_not_empty(store, word):
    store.delete("e-1", for_good=True)
    assert word("list") == (0, RECORDING_ROW, "")


def test_recovered_takes_are_marked(store, word):
    attributes = recording_attributes("r-2", None).as_interrupted()
    with store.writer(kind="recording", attributes=attributes) as writer:
        writer.append("force", values=np.ones((7, 2), "f4"), t_host_ns=np.arange(7))
    row = "r-2  recording  stand_bottle  human  7 samples  not judged  recovered\n"
    assert word("list", "--kind", "recording")[1] == RECORDING_ROW + row
    assert word("show", "r-2")[1].splitlines()[1] == "not judged  recovered"


def test_verify_tells_stages_of_running_and_of_killed_writers_apart(store, word):
    for name in ("r-2", "r-3"):
        writer = store.writer(kind="recording", attributes=recording_attributes(name, None))
        if name == "r-2":
            os.close(writer._lock)
    said = word("verify")[1].splitlines()
    for name, state in (("r-2", "unfinished"), ("r-3", "being written")):
        (line,) = (line for line in said if line.startswith(f"recording-{name}-"))
        assert line.endswith(f"  {state}  stage, 0 arrays, 0 bytes")
    assert store.sweep() == 1
    assert word("list", "--kind", "recording")[1] == RECORDING_ROW


def test_delete_list_restore_purge(store, word, tmp_path):
    assert word("delete", "e-1") == (0, "e-1  in the trash\n", "")
    assert word("list", "--kind", "episode")[1] == "nothing matches, of 0 episodes\n"
    status, out, _ = word("list", "--trash", "--json", str(tmp_path / "trash.json"))
    assert out.startswith("e-1  episode  deleted 20")
    (entry,) = json.loads((tmp_path / "trash.json").read_text())["trash"]
    assert entry["num_bytes"] > 1000
    assert word("restore", "e-1")[0] == 0
    assert store.list() == ["e-1"]
    word("delete", "e-1")
    assert word("purge", "--older-than", "30d")[1].startswith("0 purged")
    assert word("purge")[1].splitlines()[-1].startswith("1 purged")
    status, _, err = word("restore", "e-1")
    assert (status, "not in the trash" in err) == (3, True)
    word("delete", "r-1", "--for-good")
    assert store.list(kind="recording") == []
    assert store.trash_list() == []


def test_an_age_that_is_none_is_explained(word, capsys):
    with pytest.raises(SystemExit):
        word("purge", "--older-than", "3x")
    assert "expected a number and one of s m h d" in capsys.readouterr().err


def test_kinds_are_found_or_asked_for(store, word):
    write_recording(store, "e-1")
    status, _, err = word("delete", "e-1")
    assert (status, "--kind" in err) == (3, True)
    assert word("delete", "e-1", "--kind", "recording")[0] == 0
    assert store.list() == ["e-1"]
    assert word("delete", "e-1")[0] == 0
    status, _, err = word("restore", "e-1")
    assert (status, "--kind" in err) == (3, True)
    assert word("delete", "nothing")[0] == 3
    for bad in ("../../x", "a/b", ""):
        assert word("verify", bad, "--kind", "episode")[0] == 3
        assert word("repair", bad, "--kind", "episode")[0] == 3


def test_verify_names_item_array_and_storage_chunk(store, word):
    assert word("verify")[0] == 0
    flip(shard_of(store, "episodes", "e-1", "force"))
    flip(shard_of(store, "recordings", "r-1", "force_t_host_ns"))
    (store.root / "recordings" / "r-1" / "extra").write_text("")
    (store.root / "episodes" / "foreign").mkdir()
    spool = store.root / ".uploads" / "take-1"
    with SpoolWriter(spool, recording_attributes("take-1", None), sync=False) as writer:
        numbers = np.arange(9)
        writer.append("force", SampleBatch(numbers, numbers, numbers, np.ones((9, 2), "f4")))
        writer.append("force", SampleBatch(numbers + 9, numbers, numbers, np.ones((9, 2), "f4")))
    flip(spool / "batches.log", 100)
    status, out, _ = word("verify", "--json", "-")
    found = json.loads(out)
    assert status == 1
    assert "array 'force': storage chunk 0" in found["damaged"]["e-1"]
    assert "array 'force_t_host_ns': storage chunk 0" in found["damaged"]["r-1"]
    assert "extra belongs to no array" in found["damaged"]["r-1"]
    assert "commit.json is missing" in found["damaged"]["foreign"]
    assert "batch 0 of 'force'" in found["damaged"]["take-1"]
    status, out, _ = word("verify", "--kind", "recording", "r-1")
    assert (status, out.count("DAMAGED")) == (1, 2)


def test_repair_from_a_copy_and_by_salvage(store, word, tmp_path):
    shutil.copytree(store.root, tmp_path / "copy")
    flip(shard_of(store, "episodes", "e-1", "force"))
    flip(shard_of(store, "recordings", "r-1", "force"))
    (tmp_path / "copy" / "recordings" / "r-1" / "commit.json").unlink()
    status, out, _ = word("repair", "--from", str(tmp_path / "copy"))
    assert status == 0
    assert "e-1  repaired" in out
    assert "r-1  salvaged  as r-1-salvaged-1" in out
    assert "force: 5 samples lost" in out
    assert store.list(kind="recording") == ["r-1-salvaged-1"]
    assert word("verify")[0] == 0
    flip(store.root / "episodes" / "e-1" / "zarr.json")
    status, out, _ = word("repair", "e-1")
    assert (status, "e-1  left" in out) == (1, True)


@pytest.mark.parametrize("words", [["verify"], ["repair"], ["purge"], ["list", "--trash"]])
def test_a_store_that_is_not_there_is_not_in_order(tmp_path, capsys, words):
    assert main(["store", *words, "--store", str(tmp_path / "unmounted")]) == 3
    assert "unmounted: no such folder" in capsys.readouterr().err


def test_nothing_is_salvaged_where_the_copy_is_not_there(store, word, tmp_path):
    flip(shard_of(store, "recordings", "r-1", "force"))
    status, _, err = word("repair", "--from", str(tmp_path / "unmounted"))
    assert (status, "unmounted: no such folder" in err) == (3, True)
    assert store.list(kind="recording") == ["r-1"]


def test_an_item_without_its_commit_record_can_be_deleted(store, word):
    (store.root / "episodes/e-1/commit.json").unlink()
    assert word("delete", "e-1", "e-1") == (0, "e-1  in the trash\n", "")
    assert word("verify")[0] == 0
    assert not (store.root / "episodes/e-1").exists()


def derived_of(store, recording_id, episode_id):
    lineage = LineageEntry(kind="recording", id=recording_id)
    write_episode(store, episode_id, lineage=[lineage.model_dump()])


def test_an_operator_is_deleted_after_typing_the_name(store, word, tmp_path, monkeypatch):
    derived_of(store, "r-1", "e-2")
    write_recording(store, "r-2", operator="op-2")
    words = ("delete", "--operator", "op-1", "--for-good", "--receipt", str(tmp_path / "r.json"))
    for typed in ("", "op-2\n", "yes\n"):
        monkeypatch.setattr("sys.stdin", io.StringIO(typed))
        status, out, err = word(*words)
        assert status == 3
        assert "not confirmed" in err
        assert "episodes/e-2  made from recording r-1" in out
        assert store.list() == ["e-1", "e-2"]
    monkeypatch.setattr("sys.stdin", io.StringIO("op-1\n"))
    status, out, err = word(*words)
    assert status == 0
    assert "Type op-1" in err
    assert "2 removed, 0 reviews without a name, 0 references left" in out
    assert store.list() == ["e-1"]
    assert store.list(kind="recording") == ["r-2"]
    assert json.loads((tmp_path / "r.json").read_text())["counts"]["recordings"] == 1


def test_a_recording_is_deleted_with_what_was_made_of_it(store, word, tmp_path):
    derived_of(store, "r-1", "e-2")
    words = ("--recording", "r-1", "--for-good", "--yes", "--receipt")
    status, out, _ = word("delete", *words, str(tmp_path / "1.json"))
    assert status == 1
    assert "episodes/e-2/zarr.json  still names" in out
    status, out, _ = word("delete", *words, str(tmp_path / "2.json"), "--derived")
    assert status == 0
    assert store.list() == ["e-1"]


@pytest.mark.parametrize(
    "words",
    [
        (),
        ("--operator", "op-1"),
        ("--operator", "op-1", "--for-good", "--recording", "r-1", "--yes"),
        ("--operator", "op-1", "--for-good", "--yes", "e-1"),
        ("e-1", "--derived"),
        ("e-1", "--receipt", "x.json"),
        ("--operator", "nobody", "--for-good", "--yes"),
    ],
)
def test_deletions_that_are_not_clear_are_refused(store, word, words):
    status, _, err = word("delete", *words)
    assert status == 3
    assert err.startswith("dextouch store: delet")
    assert (store.list(), store.list(kind="recording")) == (["e-1"], ["r-1"])


def test_ages_and_sizes():
    assert [seconds_of(text) for text in ("30d", "12h", "5m", "7s")] == [2_592_000, 43_200, 300, 7]
    for bad in ("", "d", "30", "-1d", "1.5d", "1w"):
        with pytest.raises(argparse.ArgumentTypeError, match="30d"):
            seconds_of(bad)
    sizes = [readable_size(n) for n in (0, 999, 1000, 999_600, 12_345_678)]
    assert sizes == ["0 bytes", "999 bytes", "1 kB", "1 MB", "12.3 MB"]
    assert table([("a", "bb"), ("ccc", "d")]) == ["a    bb", "ccc  d"]
    assert table([]) == []
