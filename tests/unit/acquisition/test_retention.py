"""What leaves a spool when: acknowledged takes only, the oldest acknowledgement first."""

import os
import shutil
from pathlib import Path

import pytest
from prometheus_client import CollectorRegistry

from dextouch.schemas import RecorderStatus
from services.acquisition import retention as retention_module
from services.acquisition.health.metrics import RecorderCollector
from services.acquisition.retention import SpoolRetention, spooled_takes
from services.acquisition.settings import Retention

DAY_S = 86_400
NOW_S = 1_000 * DAY_S
MEGABYTE = 10**6
NOTE = b'{"recording_id": "take", "state": "finished"}'


def take(root, name, *, age_days=None, num_bytes=MEGABYTE):
    """A take of a size; acknowledged so many days ago, or never."""
    path = root / name
    path.mkdir(parents=True)
    (path / "recording.json").write_bytes(b"{}")
    # With "{}" and the acknowledgement, exactly the size.
    others = 2 if age_days is None else 2 + len(NOTE)
    (path / "batches.log").write_bytes(bytes(num_bytes - others))
    if age_days is not None:
        (path / "uploaded.json").write_bytes(NOTE)
        at_s = NOW_S - age_days * DAY_S
        os.utime(path / "uploaded.json", (at_s, at_s))


def swept(root, **limits):
    return SpoolRetention(root, Retention(**limits), now_s=lambda: NOW_S).sweep()


def left(root):
    return [path.name for path in spooled_takes(root)]


def test_a_take_stays_for_a_week_after_the_acknowledgement(tmp_path):
    for name, age_days in (("old", 7.01), ("young", 6.99), ("waiting", None)):
        take(tmp_path, name, age_days=age_days)
    assert swept(tmp_path) == ["old"]
    assert left(tmp_path) == ["waiting", "young"]
    assert swept(tmp_path) == []


@pytest.mark.parametrize(
    "note", [b"", bytes(200), b"{}", b'{"recording_id": "take", "state": "open"}', NOTE[:-3]]
)
def test_a_note_that_says_nothing_of_an_acknowledgement_is_none(tmp_path, note):
    take(tmp_path, "take", age_days=100)
    (tmp_path / "take" / "uploaded.json").write_bytes(note)
    assert swept(tmp_path, keep_uploaded_days=0, keep_uploaded_gb=0) == []
    assert left(tmp_path) == ["take"]


def test_what_the_store_never_acknowledged_stays_whatever_the_limits(tmp_path):
    take(tmp_path, "waiting")
    take(tmp_path, "refused")
    (tmp_path / "refused" / "refused.txt").write_text("no")
    for path in spooled_takes(tmp_path):
        os.utime(path / "recording.json", (0, 0))
    assert swept(tmp_path, keep_uploaded_days=0, keep_uploaded_gb=0) == []
    assert left(tmp_path) == ["refused", "waiting"]


def test_beyond_the_size_the_oldest_acknowledged_go(tmp_path):
    for name, age_days in (("c", 3), ("a", 1), ("b", 2)):
        take(tmp_path, name, age_days=age_days, num_bytes=4 * MEGABYTE)
    # The size of takes that wait does not count: 8 MB are just enough for two.
    take(tmp_path, "waiting", num_bytes=50 * MEGABYTE)
    assert swept(tmp_path, keep_uploaded_gb=0.008) == ["c"]
    assert swept(tmp_path, keep_uploaded_gb=0.007_999) == ["b"]
    assert left(tmp_path) == ["a", "waiting"]


@pytest.mark.parametrize("limits", [{"keep_uploaded_days": 0}, {"keep_uploaded_gb": 0}])
def test_nothing_is_kept_when_asked(tmp_path, limits):
    take(tmp_path, "a", age_days=0)
    assert swept(tmp_path, **limits) == ["a"]


def test_an_interrupted_removal_leaves_no_take_and_is_completed(tmp_path, monkeypatch):
    take(tmp_path, "a", age_days=8)

    def die(path, **_):
        if path.exists():
            raise KeyboardInterrupt

    monkeypatch.setattr(retention_module.shutil, "rmtree", die)
    with pytest.raises(KeyboardInterrupt):
        swept(tmp_path)
    monkeypatch.undo()
    assert left(tmp_path) == []
    assert len(list((tmp_path / ".removed").iterdir())) == 1
    assert swept(tmp_path) == []
    assert list((tmp_path / ".removed").iterdir()) == []


def test_a_removal_that_a_sweep_completes_first_is_no_failure(tmp_path, monkeypatch):
    take(tmp_path, "a", age_days=8)
    rename = Path.rename

    def rename_and_sweep(path, target):
        rename(path, target)
        retention_module.empty_removed(tmp_path)

    monkeypatch.setattr(Path, "rename", rename_and_sweep)
    retention_module.remove_take(tmp_path / "a")
    assert [path.name for path in tmp_path.rglob("*")] == [".removed"]


def test_metrics_show_the_spools_use_and_the_limits(tmp_path):
    take(tmp_path, "a", age_days=1, num_bytes=3 * MEGABYTE)
    take(tmp_path, "b", num_bytes=2 * MEGABYTE)
    registry = CollectorRegistry()
    limits = Retention(keep_uploaded_days=2, keep_uploaded_gb=5)
    status = RecorderStatus(state="idle", actions=("arm",), problems=())
    retention = SpoolRetention(tmp_path, limits)
    registry.register(RecorderCollector(lambda: status, dict, retention))
    for state, num_bytes in (("uploaded", 3e6), ("waiting", 2e6), ("refused", 0)):
        assert registry.get_sample_value("dextouch_spool_bytes", {"state": state}) == num_bytes
    assert registry.get_sample_value("dextouch_spool_keep_seconds") == 172_800
    assert registry.get_sample_value("dextouch_spool_keep_bytes") == 5e9


def test_a_take_of_the_same_name_as_a_half_removed_one_can_be_removed(tmp_path):
    take(tmp_path, "a", age_days=8)
    shutil.copytree(tmp_path / "a", tmp_path / ".removed" / "a")
    assert swept(tmp_path) == ["a"]
    assert left(tmp_path) == []
