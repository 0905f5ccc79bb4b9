"""`dextouch export` and `dextouch import`: what is chosen, where it goes, what is refused."""

import json
import sys
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
import zarr

from dextouch.episodes import EpisodeStore, GopEncoder, VideoSettings
from dextouch.images import encode_jpeg
from dextouch.schemas import Review
from dextouch.streams import encoded_values
from services.cli import main
from tests.unit.bridges.foreign_lerobot import arm
from tests.unit.bridges.lerobot_episodes import make_episode, pictures
from tests.unit.bridges.takes import differing_streams, write_episode, write_recording

TOP = "observation.images.top"


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


@pytest.fixture
def dextouch(tmp_path, capsys):
    """Run the command line on the store; its status, its stdout and its stderr."""

    def run(*words, store="store"):
        status = main.main([*map(str, words), "--store", str(tmp_path / store)])
        return status, *capsys.readouterr()

    return run


def names(folder):
    return sorted(path.name for path in folder.iterdir() if path.name != "foxglove_layout.json")


def test_one_episode_goes_to_one_file_and_comes_back(store, dextouch, tmp_path):
    reader = write_episode(store)
    path, report = tmp_path / "take.mcap", tmp_path / "report.json"
    words = ("export", "--format", "mcap", "stand-bottle-0003", "--to", path, "--json", report)
    status, out, _ = dextouch(*words)
    assert status == 0
    assert str(path) in out
    (file,) = json.loads(report.read_text())["files"]
    assert (file["id"], file["path"]) == ("stand-bottle-0003", str(path))
    assert file["num_messages"] > sum(reader.num_samples(name) for name in reader.streams)
    status, out, _ = dextouch("import", "--format", "mcap", path, store="other")
    assert (status, out) == (0, "stand-bottle-0003\n")
    again = EpisodeStore(tmp_path / "other").open("stand-bottle-0003")
    assert differing_streams(reader, again) == []


def test_filters_choose_and_files_go_into_a_folder(store, dextouch, tmp_path):
    write_recording(store, "take-0001", count=5)
    write_recording(store, "take-0002", count=5)
    folder = tmp_path / "takes"
    words = ("export", "--format", "mcap", "--kind", "recording", "--to", folder)
    status, _, err = dextouch(*words, "--operator", "p18")
    assert (status, folder.exists()) == (main.EXIT_REFUSED, False)
    assert "p18" in err
    assert dextouch(*words, "--operator", "p17", "--domain", "human")[0] == 0
    assert names(folder) == ["take-0001.mcap", "take-0002.mcap"]
    assert dextouch("import", "--format", "mcap", folder, store="other")[0] == 0
    assert EpisodeStore(tmp_path / "other").list(kind="recording") == ["take-0001", "take-0002"]


@pytest.mark.long
def test_filters_are_those_of_the_dashboards_list(store, dextouch, tmp_path):
    noon = datetime(2026, 5, 4, 12, tzinfo=UTC)
    takes = {
        "a": {"started_at": noon, "success": True, "station": "bench-1"},
        "b": {"started_at": noon + timedelta(days=1), "success": False},
        "c": {"started_at": noon + timedelta(days=2)},
        "d": {},
    }
    for name, take in takes.items():
        write_recording(store, name, count=5, **take)
    verdict = Review(verdict="accepted", reviewed_at=noon)
    store.set_review("b", verdict, kind="recording")
    store.set_review("c", verdict.model_copy(update={"verdict": "rejected"}), kind="recording")
    cases = {
        "--outcome success": "a",
        "--outcome failure": "b",
        "--outcome not_judged --with-rejected": "cd",
        "--review accepted": "b",
        "--review rejected": "c",
        "--review not_reviewed": "ad",
        "--station bench-1": "a",
        "--text BENCH-2": "bd",
        "--task stand_bottle": "abd",
        "--after 2026-05-05": "b",
        "--after 2026-05-04T13:00+01:00 --before 2026-05-05T12:00Z": "a",
        "--after 2026-05-05T12:00Z --with-rejected": "bc",
    }
    for number, (words, expected) in enumerate(cases.items()):
        to = tmp_path / str(number)
        given = ("export", "--format", "mcap", "--kind", "recording", "--to", to)
        status, _, err = dextouch(*given, *words.split())
        assert (status, names(to)) == (0, [f"{name}.mcap" for name in expected]), (words, err)
    with pytest.raises(SystemExit):
        dextouch("export", "--format", "mcap", "--to", tmp_path / "x", "--after", "yesterday")
    status, _, err = dextouch(
        "export", "--format", "mcap", "--to", tmp_path / "x", "--text", "x" * 201
    )
    assert status == main.EXIT_REFUSED
    assert "text" in err


def test_a_damaged_item_is_told_and_not_left_out(store, dextouch, tmp_path):
    write_episode(store, "one", num_steps=3)
    write_episode(store, "two", num_steps=3)
    (store.root / "episodes/one/zarr.json").write_text("{")
    status, _, err = dextouch("export", "--format", "mcap", "--to", tmp_path / "x")
    assert (status, (tmp_path / "x").exists()) == (main.EXIT_REFUSED, False)
    assert "one" in err


def test_a_layout_for_foxglove_is_written_with_the_files(store, dextouch, tmp_path):
    write_recording(store, "take-0001", count=5)
    words = ("export", "--format", "mcap", "--kind", "recording", "take-0001", "--to")
    status, _, err = dextouch(*words, tmp_path / "takes")
    assert status == 0
    assert "1 of 1 do not know when they were recorded" in err
    beside = json.loads((tmp_path / "takes/foxglove_layout.json").read_text())
    assert "Image!tactile_left" in beside["configById"]
    one, chosen = tmp_path / "take.mcap", tmp_path / "layout.json"
    assert dextouch(*words, one)[0] == 0
    assert not (tmp_path / "foxglove_layout.json").exists()
    assert dextouch(*words, tmp_path / "two.mcap", "--layout", chosen)[0] == 0
    assert json.loads(chosen.read_text()) == beside
    status, _, err = dextouch(*words, tmp_path / "three.mcap", "--layout", chosen)
    assert (status, (tmp_path / "three.mcap").exists()) == (main.EXIT_REFUSED, False)
    assert "layout.json: exists already" in err
    words = ("export", "--format", "umi", "--to", tmp_path / "x.zip", "--layout", chosen)
    assert "--layout is for format mcap" in dextouch(*words, "--force")[2]


def test_a_layout_is_written_over_nothing(store, dextouch, tmp_path):
    write_episode(store, num_steps=3)
    words = ("export", "--format", "mcap", "stand-bottle-0003", "--to")
    (tmp_path / "takes").mkdir()
    beside = tmp_path / "takes" / "foxglove_layout.json"
    beside.write_text("mine")
    status, _, err = dextouch(*words, tmp_path / "takes")
    assert status
    assert "foxglove_layout.json: exists already" in err
    assert [path.name for path in (tmp_path / "takes").iterdir()] == [beside.name]
    both = tmp_path / "q.mcap"
    status, _, err = dextouch(*words, both, "--layout", both, "--force")
    assert status
    assert "is one of the exported files" in err


@pytest.mark.parametrize(
    ("form", "flags", "right"),
    [
        ("mcap", ["--fps", "30"], "lerobot"),
        ("rrd", ["--touch-samples"], "lerobot"),
        ("umi", ["--license", "mit"], "lerobot"),
        ("mcap", ["--repo-id", "a/b"], "lerobot"),
        ("rrd", ["--jpeg-quality", "90"], "mcap"),
        ("lerobot", ["--no-touch-images"], "mcap"),
        ("import", ["--fps", "30"], "lerobot"),
        ("import", ["--k-head", "1,1,1,1"], "lerobot"),
        ("import", ["--timeline", "t"], "rrd"),
        ("import", ["--task", "wipe"], "leave --task out"),
    ],
)
def test_options_that_a_format_ignores_are_refused(form, flags, right, store, dextouch, tmp_path):
    write_episode(store, num_steps=3)
    path = tmp_path / "take.mcap"
    if form == "import":
        dextouch("export", "--format", "mcap", "--to", path)
        status, _, err = dextouch("import", path, *flags, store="other")
    else:
        status, _, err = dextouch("export", "--format", form, "--to", tmp_path / "x", *flags)
    assert status
    assert flags[0] in err
    assert right in err


def test_a_folder_of_two_formats_needs_a_choice(dextouch, tmp_path):
    for name in ("a.mcap", "b.rrd"):
        (tmp_path / name).write_bytes(b"")
    status, _, err = dextouch("import", tmp_path)
    assert status
    assert "choose one with --format" in err
    # Names in capitals are of the format, too; those of operating systems are not.
    (tmp_path / "a.mcap").rename(tmp_path / "A.MCAP")
    (tmp_path / "._b.mcap").write_bytes(b"")
    _, _, err = dextouch("import", "--format", "mcap", tmp_path)
    assert "A.MCAP: is not an MCAP file" in err
    assert "choose one" in dextouch("import", tmp_path)[2]


def test_what_was_rejected_in_review_is_left_out_unless_it_is_asked_for(store, dextouch, tmp_path):
    rejected = Review(verdict="rejected", reviewed_at=datetime(2026, 5, 4, tzinfo=UTC))
    for name in ("take-0001", "take-0002"):
        write_recording(store, name, count=5)
    for name in ("one", "two"):
        write_episode(store, name, num_steps=3)
    store.set_review("take-0001", rejected, kind="recording")
    store.set_review("two", rejected)
    words = ("export", "--format", "mcap")
    status, _, err = dextouch(*words, "--kind", "recording", "--to", tmp_path / "takes")
    assert (status, names(tmp_path / "takes")) == (0, ["take-0002.mcap"])
    assert "1 rejected in review left out" in err
    assert dextouch(*words, "--to", tmp_path / "episodes")[0] == 0
    assert names(tmp_path / "episodes") == ["one.mcap"]
    assert dextouch(*words, "--with-rejected", "--to", tmp_path / "all")[0] == 0
    assert names(tmp_path / "all") == ["one.mcap", "two.mcap"]
    assert dextouch(*words, "two", "--to", tmp_path / "two.mcap")[0] == 0


def test_filters_and_ids_exclude_each_other(store, dextouch, tmp_path):
    write_episode(store, "one", num_steps=3)
    words = ("export", "--format", "mcap", "--to", tmp_path / "out")
    for more, expected in (
        (("one", "--task", "stand_bottle"), "filters"),
        (("one", "one"), "twice"),
        (("two",), "'two'"),
        (("--task", "stack_bowls"), "stack_bowls"),
    ):
        status, _, err = dextouch(*words, *more)
        assert status == main.EXIT_REFUSED
        assert expected in err
    assert not (tmp_path / "out").exists()


def test_nothing_is_written_over_without_force(store, dextouch, tmp_path):
    for episode_id in ("one", "two"):
        write_episode(store, episode_id, num_steps=3)
    folder = tmp_path / "takes"
    folder.mkdir()
    (folder / "two.mcap").write_bytes(b"mine")
    words = ("export", "--format", "mcap", "--to", folder)
    status, _, err = dextouch(*words)
    assert status == main.EXIT_REFUSED
    assert "--force" in err
    assert names(folder) == ["two.mcap"]
    assert dextouch(*words, "--force")[0] == 0
    assert (folder / "two.mcap").read_bytes() != b"mine"
    status, _, err = dextouch("export", "--format", "mcap", "--to", tmp_path / "all.mcap")
    assert status == main.EXIT_REFUSED
    assert "name a folder" in err


def test_umi_takes_all_episodes_into_one_zip(store, dextouch, tmp_path):
    for seed, episode_id in enumerate(("one", "two")):
        write_episode(store, episode_id, num_steps=5, seed=seed)
    path = tmp_path / "all.zarr.zip"
    status, out, _ = dextouch("export", "--format", "umi", "--to", path)
    assert status == 0
    assert "2 episodes  10 steps" in out
    group = zarr.open_group(zarr.storage.ZipStore(path, mode="r"), mode="r")
    assert group["meta/episode_ends"][:].tolist() == [5, 10]
    status, _, err = dextouch(
        "export", "--format", "umi", "--kind", "recording", "--to", tmp_path / "x.zip"
    )
    assert status == main.EXIT_REFUSED
    assert "episodes only" in err


def test_lerobot_replaces_only_what_is_a_data_set(store, dextouch, tmp_path):
    write_episode(store, "one", num_steps=5)
    folder = tmp_path / "data"
    words = ("export", "--format", "lerobot", "--to", folder)
    assert dextouch(*words)[0] == 0
    assert json.loads((folder / "meta" / "info.json").read_text())["total_episodes"] == 1
    status, _, err = dextouch(*words)
    assert status == main.EXIT_REFUSED
    assert "--force" in err
    assert dextouch(*words, "--fps", "0", "--force")[0] == main.EXIT_REFUSED
    with pytest.raises(SystemExit) as usage:
        dextouch(*words, "--fps", "29.97", "--force")
    assert usage.value.code == main.EXIT_USAGE
    assert (folder / "meta" / "info.json").is_file()
    assert dextouch(*words, "--force")[0] == 0
    assert names(tmp_path) == ["data", "store"]
    status, out, _ = dextouch("import", "--format", "lerobot", folder, store="other")
    # The exported groups of two images are not those of the store.
    assert (status, out.splitlines()[-1]) == (0, "one")
    assert "observation.images.camera_head: decoded, encoded as h264" in out
    status, out, _ = dextouch("import", "--format", "lerobot", folder, store="other")
    assert (status, out) == (0, "1 episodes of these files are in the store already\n")
    (folder / "meta" / "info.json").unlink()
    status, _, err = dextouch(*words, "--force")
    assert status == main.EXIT_REFUSED
    assert "not a LeRobot data set" in err


def test_lerobot_data_sets_grow_and_get_a_card(store, dextouch, tmp_path):
    write_episode(store, "one", num_steps=5)
    folder, report = tmp_path / "data", tmp_path / "report.json"
    words = ("export", "--format", "lerobot", "--to", folder, "--json", report)
    assert dextouch(*words, "--license", "cc-by-4.0", "--touch-samples")[0] == 0
    write_episode(store, "two", num_steps=4)
    status, _, err = dextouch(*words, "--append")
    assert status == main.EXIT_REFUSED
    assert "with --touch-samples" in err
    status, out, err = dextouch(*words, "--append", "--touch-samples")
    assert (status, "1 episodes  4 steps" in out) == (0, True)
    assert "1 episodes were in the data set already" in err
    assert json.loads(report.read_text())["present"] == ["one"]
    assert "license: cc-by-4.0" in (folder / "README.md").read_text()
    assert dextouch("import", folder, store="other")[1].endswith("one\ntwo\n")
    words = ("export", "--format", "umi", "--append", "--to", tmp_path / "all.zip")
    status, _, err = dextouch(*words)
    assert status == main.EXIT_REFUSED
    assert "--append is for format lerobot" in err


def test_a_lerobot_data_set_has_the_cameras_that_are_chosen(store, dextouch, tmp_path):
    write_episode(store, "one", num_steps=5)
    words = ("export", "--format", "lerobot", "--to", tmp_path / "data", "--cameras")
    status, _, err = dextouch(*words, "camera_chest")
    assert status == main.EXIT_REFUSED
    assert "episode 'one': has no camera ['camera_chest']" in err
    assert dextouch(*words, "camera_wrist_left")[0] == 0
    info = json.loads((tmp_path / "data/meta/info.json").read_text())
    images = [name for name in info["features"] if name.startswith("observation.images.")]
    assert images == ["observation.images.camera_wrist_left"]


def test_a_lerobot_data_set_of_another_robot_becomes_recordings(store, dextouch, tmp_path):
    folder, report = arm().write_v21(tmp_path / "arm"), tmp_path / "report.json"
    words = ("import", folder, "--json", report, "--map", f"camera_head={TOP}")
    status, out, _ = dextouch(*words, "--k-head", "60,60,32,24", "--fps", "5", "--task", "cubes")
    assert status == 0
    assert out.startswith("imported as recordings: 'action': 'action' is float32 [7], expected")
    assert f"  camera_head  <- {TOP}  h264 [48, 64, 3]  12 samples, 5 Hz" in out
    assert "kept as numbers: text as UTF-8" in out
    told = json.loads(report.read_text())
    assert told["ids"] == ["arm-000000", "arm-000001"] == store.list(kind="recording")
    assert {one["stream"] for one in told["reports"][0]["imported"]} >= {"action", "subtask"}
    assert (told["failed"], told["present"]) == ({}, [])
    (folder / "videos/chunk-000" / TOP / "episode_000000.mp4").unlink()
    status, out, err = dextouch(*words, "--id-prefix", "again-")
    assert status == 3
    assert "again-arm-000001" in out
    assert f"{folder}: episode 0: not imported: " in err
    told = json.loads(report.read_text())
    assert (told["ids"], [*told["failed"]]) == (["again-arm-000001"], ["episode 0"])
    about = store.recording("arm-000000").attributes
    assert about.calibration["K_head"] == ((60, 0, 32), (0, 60, 24), (0, 0, 1))
    assert (about.task, about.domain) == ("cubes", "robot")
    with pytest.raises(SystemExit) as usage:
        dextouch(*words, "--k-head", "60,60,32")
    assert usage.value.code == main.EXIT_USAGE


@pytest.mark.long
@pytest.mark.parametrize("form", ["lerobot", "mcap"])
@pytest.mark.parametrize("unit", ["jpeg", "h264"])
def test_damaged_images_are_left_out_and_named(store, dextouch, tmp_path, form, unit):
    write_damaged(store, unit, damaged=(5, 18))
    lost = [5, 18] if unit == "jpeg" else [5, 6, 7, 18, 19, 20]
    report = tmp_path / "report.json"
    to = tmp_path / {"lerobot": "set", "mcap": "take.mcap"}[form]
    words = ("export", "--format", form, "take", "--to", to, "--json", report)
    status, _, err = dextouch(*words)
    assert status == 0
    assert f"take: camera_head: {len(lost)} of 21 images cannot be decoded" in err
    assert json.loads(report.read_text())["damaged_images"] == {"take": {"camera_head": lost}}
    status, _, err = dextouch("import", "--format", form, to, store="again")
    assert status == 0, err
    (name,) = EpisodeStore(tmp_path / "again").list(kind="episode")
    again = EpisodeStore(tmp_path / "again").open(name)
    assert not len(again.damaged_images("camera_head"))
    # On the grid the neighbours' images have their own times; else whole groups are left out.
    kept = np.delete(np.arange(21), lost)
    if (form, unit) == ("mcap", "h264"):
        kept = np.arange(8, 16)
    stamps = store.open("take").stamps_ns("camera_head")
    np.testing.assert_array_equal(again.stamps_ns("camera_head"), stamps[kept])


@pytest.mark.long
@pytest.mark.parametrize("form", ["lerobot", "umi"])
def test_an_episode_without_a_whole_image_does_not_stop_a_data_set(store, dextouch, tmp_path, form):
    write_damaged(store, "jpeg", damaged=(5,))
    write_damaged(store, "jpeg", damaged=range(21), episode_id="blind")
    report = tmp_path / "report.json"
    to = tmp_path / {"lerobot": "set", "umi": "set.zarr.zip"}[form]
    words = ("export", "--format", form, "take", "blind", "--to", to, "--json", report)
    status, out, err = dextouch(*words)
    assert status == 0, err
    assert "blind: left out: no image of camera_head is whole" in err
    assert "1 episodes" in out
    assert json.loads(report.read_text())["left_out"] == ["blind"]


def write_damaged(store, unit, damaged, *, episode_id="take"):
    """An episode of 21 images, one a step, of which some are cut."""
    made = make_episode(num_steps=21)
    made.set_unit(unit, "camera_head")
    images = pictures(21)
    encoder = GopEncoder(48, 64, rate_hz=15.0, settings=VideoSettings())
    encode = encode_jpeg if unit == "jpeg" else encoder.encode
    encoded = [encode(image) for image in images]
    for index in damaged:
        encoded[index] = encoded[index][: len(encoded[index]) * 6 // 10]
    made.values["camera_head"] = encoded_values(encoded)
    made.stamps_ns["camera_head"] = made.stamps_ns["action"].copy()
    made.write(store, episode_id=episode_id)


def test_rerun_files_are_written(store, dextouch, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install '.[rerun]'")
    write_episode(store, "one", num_steps=3)
    assert dextouch("export", "--format", "rrd", "one", "--to", tmp_path / "one.rrd")[0] == 0
    assert (tmp_path / "one.rrd").stat().st_size > 0


def test_a_missing_package_is_named_with_its_extra(store, dextouch, tmp_path, monkeypatch):
    write_episode(store, "one", num_steps=3)
    monkeypatch.delitem(sys.modules, "dextouch.bridges.rerun", raising=False)
    monkeypatch.setitem(sys.modules, "rerun", None)
    status, _, err = dextouch("export", "--format", "rrd", "one", "--to", tmp_path / "one.rrd")
    assert status == main.EXIT_REFUSED
    assert "[rerun]" in err


def test_files_that_are_not_there_are_refused(dextouch, tmp_path):
    for form in ("mcap", "lerobot"):
        status, _, err = dextouch("import", "--format", form, tmp_path / "nothing")
        assert status == main.EXIT_REFUSED
        assert "nothing" in err
    (tmp_path / "empty").mkdir()
    status, _, err = dextouch("import", "--format", "mcap", tmp_path / "empty")
    assert status == main.EXIT_REFUSED
    assert "no .mcap" in err


@pytest.mark.parametrize("word", ["export", "import"])
def test_help_teaches_with_examples(word, capsys):
    with pytest.raises(SystemExit):
        main.main([word, "--help"])
    text = capsys.readouterr().out
    assert f"dextouch {word} --format mcap" in text
    assert "lerobot" in text


def test_a_rerun_file_that_ends_its_reader_is_an_error(dextouch, tmp_path):
    rr = pytest.importorskip("rerun")
    for name in ("a", "b"):
        stream = rr.RecordingStream("lab")
        stream.save(tmp_path / f"{name}.rrd")
        for k in range(3):
            stream.set_time("camera", timestamp=np.datetime64(1_700_000_000 + k, "s"))
            stream.log("glove", rr.AnyValues(pressure=[1.0 * k]))
        stream.disconnect()
    # Rust panics at a zero byte in a name where it cannot unwind.
    path = tmp_path / "a.rrd"
    path.write_bytes(path.read_bytes().replace(b"pressure", b"pre\0sure", 1))
    status, _, err = dextouch("import", path)
    assert status == main.EXIT_REFUSED
    assert "a.rrd: rerun-sdk ended its process" in err
    folder = tmp_path / "both"
    folder.mkdir()
    for name in ("a", "b"):
        (tmp_path / f"{name}.rrd").rename(folder / f"{name}.rrd")
    status, out, err = dextouch("import", folder)
    assert status == 3
    assert "glove" in out
    assert "a.rrd: not imported" in err
    assert EpisodeStore(tmp_path / "store").recording("b").values("glove", 2, 3).tolist() == [[2]]
