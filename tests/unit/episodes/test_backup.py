"""Backups of a store in use: complete, incremental, true to deletions, and restored elsewhere."""

import shutil
import stat
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import pytest

from dextouch.episodes import EpisodeStore
from dextouch.episodes.editing import back_up, restore_backup
from dextouch.episodes.editing.backup import read_backup_list
from dextouch.episodes.maintenance import (
    DeletionRecords,
    DeletionRequest,
    TakeFacts,
    delete_for_good,
)
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    InvalidInputError,
    NotFoundError,
    StorageFullError,
)
from dextouch.schemas import EpisodeClicks, ItemNotes, Review, TimedNote
from services.cli.main import main
from tests.contracts.s3_server import CREDENTIALS, running_s3
from tests.unit.episode_store.episodes import write_episode, write_recording, write_take

GOLDEN = Path(__file__).parents[2] / "golden"
NOON = datetime(2026, 5, 4, 12, tzinfo=UTC)
ACCEPTED = Review(verdict="accepted", reviewer="p-7", reviewed_at=NOON)
NOTES = ItemNotes(
    notes=(TimedNote(number=3, start_ns=0, stop_ns=9, text="slips", written_at=NOON),)
)


@pytest.fixture
def stores(tmp_path):
    return [EpisodeStore(tmp_path / name / "store") for name in ("source", "backup", "restored")]


def actions(reports):
    return {(one.kind, one.item_id): one.action for one in reports}


def differences(one, other):
    """What `diff` finds between the items of two stores."""
    found = ""
    for folder in ("episodes", "recordings"):
        words = ["diff", "-r", str(one.root / folder), str(other.root / folder)]
        found += subprocess.run(words, capture_output=True, text=True, check=False).stdout
    return found


def restored(backup, target):
    shutil.rmtree(target.root, ignore_errors=True)
    reports = restore_backup(backup, target)
    assert {one.action for one in reports} <= {"copied"}, reports
    assert main(["store", "verify", "--store", str(target.root)]) == 0
    return target


def test_a_backup_is_incremental_and_restores_every_byte(stores):
    source, backup, target = stores
    write_take(source, "take")
    source.set_review("take-aligned", ACCEPTED)
    source.set_clicks("take-aligned", EpisodeClicks.model_validate({"objects": {}}))
    source.change_notes("take", lambda _: NOTES, kind="recording")
    # Neither an item, nor damage.
    (source.root / "episodes/.DS_Store").touch()
    (source.root / "episodes/half").mkdir()
    assert set(actions(back_up(source, backup)).values()) == {"copied"}
    (source.root / "episodes/.DS_Store").unlink()
    (source.root / "episodes/half").rmdir()
    assert not differences(source, backup)
    assert not (backup.root / "episodes/take-aligned/action/c/0/0").samefile(
        source.root / "episodes/take-aligned/action/c/0/0"
    )
    # Nothing that was copied is read again, in the source or in the backup.
    for store in (source, backup):
        (store.root / "recordings/take/wrist_left/c/0/0").chmod(0)
    write_episode(source, "new")
    source.set_review("take-aligned", None)
    shards = backup.root / "episodes/take-aligned/action/c/0/0"
    before = shards.stat()
    assert actions(back_up(source, backup)) == {
        ("episode", "new"): "copied",
        ("episode", "take-aligned"): "updated",
        ("recording", "take"): "there",
    }
    assert shards.stat() == before
    for store in (source, backup):
        (store.root / "recordings/take/wrist_left/c/0/0").chmod(0o644)
    assert not differences(source, restored(backup, target))
    assert set(actions(restore_backup(backup, target)).values()) == {"there"}


def test_groups_of_earlier_formats_are_copied_as_they_are(stores):
    source, backup, target = stores
    for version in ("store_v2", "store_v3"):
        shutil.rmtree(source.root, ignore_errors=True)
        shutil.copytree(GOLDEN / version, source.root)
        back_up(source, backup, accept_deletions=True)
        assert not differences(source, restored(backup, target))


def test_what_is_written_and_deleted_meanwhile_leaves_a_consistent_backup(stores):
    source, backup, target = stores
    for name in ("a", "b", "c"):
        write_take(source, name)
    rounds = []

    def change(_):
        if not rounds:
            rounds.append(1)
            source.delete("c", kind="recording")
            source.delete("b-aligned", for_good=True)
            write_take(source, "d")
            source.set_review("a", ACCEPTED, kind="recording")

    first = actions(back_up(source, backup, on_item=change))
    assert set(first) == {("episode", "a-aligned"), ("episode", "c-aligned")} | {
        ("recording", "a"),
        ("recording", "b"),
    }
    copy = restored(backup, target)
    assert (copy.list(), copy.list(kind="recording")) == (["a-aligned", "c-aligned"], ["a", "b"])
    assert copy.review("a", kind="recording") == ACCEPTED
    back_up(source, backup)
    assert not differences(source, restored(backup, target))


def test_an_episode_never_comes_without_the_recording_that_was_there(stores):
    source, backup, target = stores
    listed = []
    write_take(source, "first")

    class Busy(EpisodeStore):
        """A store to which a take is added between any two looks at it."""

        def folder_numbers(self, *, kind="episode"):
            found = super().folder_numbers(kind=kind)
            write_take(source, f"take-{len(listed)}")
            listed.append(kind)
            return found

    for _ in range(2):
        back_up(Busy(source.root), backup)
        copy = restored(backup, target)
        for name in copy.list():
            assert copy.exists(name.removesuffix("-aligned"), kind="recording")
    assert copy.list() == ["first-aligned", *(f"take-{number}-aligned" for number in range(4))]


def test_what_is_gone_moves_to_the_trash_of_the_backup_unless_it_is_most_of_it(stores):
    source, backup, _ = stores
    for name in ("a", "b", "c"):
        write_episode(source, name)
    back_up(source, backup)
    source.delete("a")
    assert actions(back_up(source, backup))["episode", "a"] == "retired"
    assert (backup.list(), [one.item_id for one in backup.trash_list()]) == (["b", "c"], ["a"])
    write_episode(source, "a", seed=2)
    shutil.rmtree(source.root / "episodes/b")
    shutil.rmtree(source.root / "episodes/c")
    with pytest.raises(ConflictError, match=r"2 of 2 items .* --accept-deletions"):
        back_up(source, backup)
    assert backup.list() == ["b", "c"]
    back_up(source, backup, accept_deletions=True)
    assert backup.open("a").attributes.seed == 2
    with pytest.raises(NotFoundError, match="no such folder; mount"):
        back_up(EpisodeStore(source.root / "unmounted"), backup)


def test_permanent_deletions_reach_the_backup_and_outlive_the_restoration(stores, tmp_path):
    source, backup, target = stores
    for name, operator in (("hers", "p-1"), ("his", "p-2")):
        write_take(source, name, operator=operator, started_at=NOON)
    write_take(source, "old", operator="p-1", started_at=NOON)
    back_up(source, backup)
    source.delete("old", kind="recording")
    source.delete("old-aligned")
    back_up(source, backup)
    assert main(["store", "list", "--store", str(backup.root)]) == 0
    about = source.recording("hers").attributes
    delete_for_good(source.root, DeletionRequest(operator="p-1"), tmp_path / "receipt.json")
    erased = actions(back_up(source, backup))
    assert {key[1] for key, action in erased.items() if action == "erased"} == {
        *("hers", "hers-aligned", "old", "old-aligned")
    }
    words = ["grep", "-rlE", "p-1|hers-aligned", str(backup.root / "episodes"), str(backup.root)]
    found = subprocess.run(words, capture_output=True, text=True, check=False).stdout.split()
    assert found == []
    copy = restored(backup, target)
    assert (copy.list(), copy.list(kind="recording")) == (["his-aligned"], ["his"])
    records = DeletionRecords(copy.root)
    assert records.find(TakeFacts.of(about)) is not None
    assert records.has_operator("p-1")
    assert not records.has_operator("p-2")


def test_damage_in_the_source_does_not_reach_the_backup(stores, capsys):
    source, backup, target = stores
    for name in ("a", "b", "c"):
        write_episode(source, name)
    back_up(source, backup)
    shard = source.root / "episodes/a/action/c/0/0"
    shard.write_bytes(shard.read_bytes()[:-9])
    (source.root / "episodes/a/commit.json").touch()
    (source.root / "episodes/b/commit.json").unlink()
    (source.root / "episodes/c/commit.json").write_text("{}")
    write_episode(source, "d")
    shard = source.root / "episodes/d/action/c/0/0"
    shard.write_bytes(shard.read_bytes()[:-9])
    words = ["store", "backup", str(backup.root), "--store", str(source.root)]
    assert main(words) == 1
    said = capsys.readouterr().out
    assert said.count("  refused  ") == 3
    assert "3 refused, 1 there - NOT COMPLETE" in said
    assert restored(backup, target).list() == ["a", "b", "c"]
    assert main(["store", "repair", "--store", str(source.root), "--from", str(backup.root)]) == 0


def test_a_backup_that_lost_something_says_so(stores, capsys):
    source, backup, target = stores
    write_episode(source, "a")
    write_episode(source, "b")
    back_up(source, backup)
    backup.delete("a")
    shard = backup.root / "episodes/b/tactile_left/c/0/0"
    data = bytearray(shard.read_bytes())
    data[9] ^= 1
    shard.write_bytes(data)
    words = ["store", "restore-backup", str(backup.root), "--store", str(target.root)]
    assert main(words) == 1
    said = capsys.readouterr().out
    assert "a  episode  damaged  episode 'a': the backup lacks it" in said
    assert "b  episode  damaged  " in said
    # The next backup brings back the first; the other one is found by a verification.
    assert actions(back_up(source, backup))["episode", "a"] == "copied"
    assert main(["store", "verify", "--store", str(backup.root)]) == 1
    assert main(["store", "repair", "--store", str(backup.root), "--from", str(source.root)]) == 0
    assert main(words) == 0


def test_copies_without_their_commit_record_are_replaced(stores):
    source, backup, target = stores
    write_episode(source, "a")
    back_up(source, backup)
    (backup.root / "episodes/a/commit.json").unlink()
    assert actions(back_up(source, backup)) == {("episode", "a"): "copied"}
    shutil.copytree(source.root, target.root)
    (target.root / "episodes/a/commit.json").unlink()
    assert actions(restore_backup(backup, target)) == {("episode", "a"): "copied"}
    assert not differences(source, target)


def test_interrupted_backups_and_restorations_are_completed(stores):
    source, backup, target = stores
    for name in ("a", "b"):
        write_take(source, name)

    def kill(_):
        raise KeyboardInterrupt

    for _ in range(3):
        with pytest.raises(KeyboardInterrupt):
            back_up(source, backup, on_item=kill)
    back_up(source, backup)
    with pytest.raises(KeyboardInterrupt):
        restore_backup(backup, target, on_item=kill)
    assert set(actions(restore_backup(backup, target)).values()) == {"copied", "there"}
    assert not differences(source, target)


def test_an_interrupted_backup_restores_what_it_copied(stores):
    source, backup, target = stores
    for name in ("a", "b", "c"):
        write_episode(source, name)
    copied = []

    def kill(_):
        copied.append(1)
        if len(copied) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        back_up(source, backup, on_item=kill)
    assert set(actions(restore_backup(backup, target)).values()) == {"copied"}
    assert len(target.list()) == 2
    # Of an unlisted backup, too, most does not go by itself.
    shutil.rmtree(source.root / "episodes")
    (source.root / "episodes").mkdir()
    with pytest.raises(ConflictError, match="2 of 2 items"):
        back_up(source, backup)


def test_a_restoration_keeps_what_the_store_has_got_since(stores):
    source, backup, target = stores
    for name in ("judged", "other", "damaged"):
        write_episode(source, name)
    back_up(source, backup)
    restore_backup(backup, target)
    target.set_review("judged", ACCEPTED)
    target.delete("other", for_good=True)
    write_episode(target, "other", seed=2)
    for place in (target, backup):
        (place.root / "episodes/damaged/action/c/0/0").write_bytes(b"")
    found = actions(restore_backup(backup, target))
    assert {name: action for (_, name), action in found.items()} == {
        "judged": "there",
        "other": "refused",
        "damaged": "damaged",
    }
    assert target.review("judged") == ACCEPTED
    assert target.open("other").attributes.seed == 2
    assert target.exists("damaged")


def test_a_full_disk_costs_no_earlier_copy(stores, monkeypatch):
    source, backup, _ = stores
    write_episode(source, "a")
    back_up(source, backup)
    source.delete("a")
    write_episode(source, "a", seed=2)

    def full(*_args, **_changes):
        raise StorageFullError("copy a: no space left")

    with monkeypatch.context() as patch:
        patch.setattr("dextouch.episodes.writer.copy_files", full)
        assert actions(back_up(source, backup)) == {("episode", "a"): "refused"}
    assert backup.open("a").attributes.seed != 2
    assert actions(back_up(source, backup)) == {("episode", "a"): "copied"}
    assert backup.open("a").attributes.seed == 2


def test_what_is_deleted_while_it_is_backed_up_stays_deleted(stores, tmp_path):
    source, backup, target = stores
    for name in ("hers", "his"):
        write_take(source, name, operator={"hers": "p-1"}.get(name, "p-2"), started_at=NOON)
    deleted = []

    def delete(_):
        deleted.append(1)
        if len(deleted) == 4:
            delete_for_good(source.root, DeletionRequest(operator="p-1"), tmp_path / "receipt")

    back_up(source, backup, on_item=delete)
    assert backup.list(kind="recording") == ["his"]
    assert {one.item_id for one in backup.trash_list()} == set()
    # A backup that was killed before it retired them.
    write_take(backup, "hers", operator="p-1", started_at=NOON)
    found = actions(restore_backup(backup, target))
    assert found["recording", "hers"] == found["episode", "hers-aligned"] == "erased"
    assert target.list(kind="recording") == ["his"]


def test_items_and_records_that_vanish_meanwhile_are_no_failure(stores, monkeypatch):
    source, backup, _ = stores
    write_episode(source, "a")
    records = source.root / ".deleted/records"
    records.mkdir(parents=True)
    (records / "x.json.partial").write_bytes(b"{")
    (records / "gone.json").symlink_to(records / "nothing")

    def vanish(*_args, **_changes):
        source.delete("a")
        raise CorruptDataError("a: arrays/x: No such file or directory")

    monkeypatch.setattr("dextouch.episodes.writer.copy_files", vanish)
    assert back_up(source, backup) == []
    assert read_backup_list(backup).files == {}


def test_what_cannot_be_done_is_refused_and_changes_nothing(stores):
    source, backup, target = stores
    write_episode(source, "a")
    write_episode(target, "other")
    with pytest.raises(ConflictError, match="has items and is no backup"):
        back_up(source, target)
    with pytest.raises(InvalidInputError, match="lie in one another"):
        back_up(source, EpisodeStore(source.root / "backup"))
    with pytest.raises(InvalidInputError, match="both the store and its backup"):
        back_up(source, EpisodeStore(source.root))
    with pytest.raises(InvalidInputError, match=r"^restore-backup: .* lie in one another"):
        restore_backup(source, EpisodeStore(source.root / "new"))
    with pytest.raises(NotFoundError, match=r"has no backup\.json: it is no backup"):
        restore_backup(source, backup)
    back_up(source, backup)
    with pytest.raises(ConflictError, match="1 items that the backup lacks, such as 'other'"):
        restore_backup(backup, target)
    assert (source.list(), target.list()) == (["a"], ["other"])
    for text in ('{"backup_version": 2}', "{"):
        backup.put_file("backup.json", text.encode())
        with pytest.raises(CorruptDataError, match="damaged, or of a later release"):
            restore_backup(backup, EpisodeStore(target.root / "new"))


@pytest.mark.parametrize("name", ["../outside", "/outside", "episodes/a/commit.json"])
def test_a_backup_writes_no_other_files(stores, name):
    _, backup, target = stores
    at = datetime.now(UTC).isoformat()
    text = f'{{"source": "x", "finished_at": "{at}", "items": [], "files": {{"{name}": "eA=="}}}}'
    backup.put_file("backup.json", text.encode())
    with pytest.raises(CorruptDataError, match="got the file"):
        restore_backup(backup, target)


def test_keys_of_stations_are_restored_for_their_owner_alone(stores):
    source, backup, target = stores
    write_recording(source, "take")
    source.put_file("enrolments.json", b'{"enrolments": []}')
    back_up(source, backup)
    restore_backup(backup, target)
    path = target.root / "enrolments.json"
    assert path.read_bytes() == b'{"enrolments": []}'
    for each in (path, backup.root / "backup.json"):
        assert stat.S_IMODE(each.stat().st_mode) == 0o600
    path.write_bytes(b'{"enrolments": [{}]}')
    with pytest.raises(ConflictError, match=r"enrolments\.json differs"):
        restore_backup(backup, target)


def test_buckets_are_backed_up_and_hold_backups(stores, tmp_path):
    source, back, target = stores
    write_take(source, "take")
    source.set_review("take", ACCEPTED, kind="recording")
    write_episode(source, "gone")
    with running_s3() as server:
        options = CREDENTIALS | {"work_folder": str(tmp_path / "work")}
        bucket = EpisodeStore(server.url("backup"), options)
        back_up(source, bucket)
        source.delete("gone")
        assert actions(back_up(source, bucket)) == {
            ("episode", "gone"): "retired",
            ("episode", "take-aligned"): "there",
            ("recording", "take"): "there",
        }
        assert bucket.list() == ["take-aligned"]
        assert not differences(source, restored(bucket, target))
        bucket.set_review("take", None, kind="recording")
        # A bucket is the source.
        back_up(bucket, back)
        source.set_review("take", None, kind="recording")
        assert not differences(source, back)
        assert set(actions(back_up(bucket, back)).values()) == {"there"}
