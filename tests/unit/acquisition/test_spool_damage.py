"""Random damages of a station's spool: nothing is lost, and nothing changes, unnoticed."""

import json
import random
import shutil

import numpy as np
import pytest

from dextouch.episodes.spool import SpoolReader, SpoolWriter
from dextouch.errors import CorruptDataError
from dextouch.images import encode_jpeg
from dextouch.schemas import LedgerEntry, RecordingAttributes
from dextouch.streams import SampleBatch, StreamDescriptor, encoded_values
from services.acquisition.settings import Retention
from services.acquisition.uploader import Uploader, recover_spool
from tests.unit.acquisition.test_uploader import FakeStore

FORCE = StreamDescriptor(
    name="force", kind="scalar", shape=(6,), dtype="float32", unit="N", nominal_rate_hz=100
)
CAMERA = StreamDescriptor(
    name="camera", kind="image", shape=(8, 8, 3), dtype="uint8", unit="jpeg", nominal_rate_hz=30
)
TAKE = RecordingAttributes(
    recording_id="take-1",
    task="stand_bottle",
    instruction="stand the bottle up",
    domain="human",
    station="desk_3",
    operator="p-07",
    consent=True,
    started_t_host_ns=123_456_789,
    calibration={"K_head": ((500.0, 0.0, 320.0), (0.0, 500.0, 240.0), (0.0, 0.0, 1.0))},
    ledger=(LedgerEntry(stream="force", event="lost", count=3),),
    streams=(FORCE, CAMERA),
)
NUM_FORCE, NUM_IMAGES = 40, 12
IMAGES = [encode_jpeg(np.full((8, 8, 3), 20 * k, np.uint8)) for k in range(NUM_IMAGES)]


def force(first, count=1, *, offset_n=0.0):
    k = np.arange(first, first + count)
    return SampleBatch(k * 10, k * 9, k, (k[:, None] * np.arange(6) + offset_n).astype("f4"))


def image(first, count=1):
    k = np.arange(first, first + count)
    return SampleBatch(k * 33, k * 33, k, encoded_values(IMAGES[first : first + count]))


EXPECTED = {"force": force(0, NUM_FORCE), "camera": image(0, NUM_IMAGES)}


def make(root, *, closed, offset_n=0.0):
    writer = SpoolWriter(root / "take-1", TAKE, sync=False)
    for k in range(NUM_FORCE):
        writer.append_record(writer.encode("force", force(k, offset_n=offset_n)))
        if k < NUM_IMAGES:
            writer.append("camera", image(k))
    if closed:
        writer.close()
    else:
        writer.abandon()


def damage(rng, data):
    """Flip a bit, cut the end, zero a range or remove one."""
    kind, data = rng.choice(("flip", "cut", "zero", "remove")), bytearray(data)
    place = rng.randrange(len(data))
    length = rng.choice((1, 2, rng.randint(1, 64), rng.randint(1, len(data))))
    if kind == "flip":
        data[place] ^= 1 << rng.randrange(8)
    elif kind == "cut":
        del data[place:]
    elif kind == "zero":
        data[place : place + length] = bytes(len(data[place : place + length]))
    else:
        del data[place : place + length]
    return bytes(data)


def same(batch, expected, count):
    return all(
        np.array_equal(got, wanted[:count])
        for got, wanted in zip(vars(batch).values(), vars(expected).values(), strict=True)
    )


def check_whole(spool):
    assert spool.attributes == TAKE
    for name, expected in EXPECTED.items():
        assert same(spool.read(name), expected, len(expected)), name


def check_recovered(spool):
    """What is there is right, and the ledger says that and what is missing."""
    events = {entry.event: entry.count for entry in spool.attributes.ledger}
    assert spool.attributes.recovered
    assert events["interrupted"] == 1
    known = [entry for entry in spool.attributes.ledger if entry.event == "lost"]
    changed = {"ledger": known, "recovered": False}
    assert RecordingAttributes.model_validate(spool.attributes.model_dump() | changed) == TAKE
    for name, expected in EXPECTED.items():
        count = spool.num_samples(name)
        assert same(spool.read(name), expected, count), name
    return events


def outcome(root, *, closed):
    """What the next start of the station makes of a damaged take: read as it was, or named."""
    path = root / "take-1"
    num_bytes = (path / "batches.log").stat().st_size
    recover_spool(root)
    assert path.is_dir()
    store = FakeStore()
    uploader = Uploader(root, store, period_s=1.0)
    done = uploader.upload_all()
    if not done:
        assert store.finished == {}
        (status,) = uploader.status()
        assert "take-1" in status.error
        assert uploader.status_of("take-1").error == status.error
        return "refused"
    spool = SpoolReader(path)
    if closed:
        check_whole(spool)
        return "whole"
    events = check_recovered(spool)
    sent = {name: sum(map(len, store.batches["take-1"][name])) for name in EXPECTED}
    assert sent == {name: spool.num_samples(name) for name in EXPECTED}
    is_whole = sent == {"force": NUM_FORCE, "camera": NUM_IMAGES}
    if is_whole:
        assert "torn_bytes" not in events
        return "whole"
    # Where the log ends with a whole record, nothing but the mark of the kill can tell.
    torn = num_bytes - (path / "batches.log").stat().st_size
    assert events.get("torn_bytes", 0) == torn
    return "recovered"


def check_damages(tmp_path, count, seed):
    rng, found = random.Random(seed), {}
    for closed in (True, False):
        make(tmp_path / f"whole-{closed}", closed=closed)
    for trial in range(count):
        closed, root = trial % 2 == 0, tmp_path / str(trial)
        shutil.copytree(tmp_path / f"whole-{closed}", root)
        names = ("batches.log", "recording.json", *(("closed",) if closed else ()))
        file = root / "take-1" / rng.choice(names)
        before = file.read_bytes()
        file.write_bytes(damage(rng, before))
        if file.read_bytes() == before:
            continue
        kind = (closed, file.name, outcome(root, closed=closed))
        found[kind] = found.get(kind, 0) + 1
        shutil.rmtree(root)
    return found


@pytest.mark.long
def test_damages_of_a_spool_are_noticed(tmp_path):
    found = check_damages(tmp_path, 150, seed=1)
    outcomes = {(closed, result) for closed, _, result in found}
    # Of a closed spool a damage is refused; an emptied seal is that of an earlier release.
    assert outcomes >= {(True, "refused"), (False, "refused"), (False, "recovered")}
    assert not [kind for kind in found if kind[1] == "recording.json" and kind[2] != "refused"]
    assert not [kind for kind in found if kind[:2] == (True, "batches.log") and kind[2] == "whole"]


@pytest.mark.slow
def test_1200_damages_of_a_spool_are_noticed(tmp_path):
    assert sum(check_damages(tmp_path, 1200, seed=2).values()) > 1100


def half_a_log(path):
    """Cut the log of a take in its middle, between two records."""
    data = (path / "batches.log").read_bytes()
    (path / "batches.log").write_bytes(data[: data.index(b"DXTS", len(data) // 2)])


def test_a_closed_take_that_lost_its_tail_is_neither_sent_nor_removed(tmp_path):
    make(tmp_path, closed=True)
    half_a_log(tmp_path / "take-1")
    store = FakeStore()
    uploader = Uploader(tmp_path, store, period_s=1.0, retention=Retention(keep_uploaded_days=0))
    assert recover_spool(tmp_path) == []
    assert uploader.upload_all() == []
    assert store.batches == {}
    (status,) = uploader.status()
    assert "was closed and has changed since: its log has" in status.error
    # Without `closed`, somebody decides to keep what is left.
    (tmp_path / "take-1" / "closed").unlink()
    assert recover_spool(tmp_path) == ["take-1"]
    check_recovered(SpoolReader(tmp_path / "take-1"))


def test_a_closed_take_of_an_earlier_release_is_sent_unless_its_tail_is_torn(tmp_path):
    for name, lost_bytes in (("whole", 0), ("torn", 3)):
        make(tmp_path / name, closed=True)
        path = tmp_path / name / "take-1"
        (path / "closed").write_bytes(b"")
        (path / "recording.json").write_text(TAKE.model_dump_json())
        data = (path / "batches.log").read_bytes()
        (path / "batches.log").write_bytes(data[: len(data) - lost_bytes])
    check_whole(SpoolReader(tmp_path / "whole" / "take-1"))
    uploader = Uploader(tmp_path / "torn", FakeStore(), period_s=1.0)
    assert uploader.upload_all() == []
    assert "of its log are no record" in uploader.status()[0].error
    with pytest.raises(CorruptDataError, match="has changed since"):
        SpoolWriter.resume(tmp_path / "torn" / "take-1")


@pytest.mark.parametrize(
    ("field", "value"), [("num_samples", {"force": 20, "camera": 12}), ("log_bytes", 4000)]
)
def test_a_seal_of_another_log_is_refused(tmp_path, field, value):
    make(tmp_path, closed=True)
    file = tmp_path / "take-1" / "closed"
    file.write_text(json.dumps(json.loads(file.read_text()) | {field: value}))
    with pytest.raises(CorruptDataError, match="has changed since"):
        SpoolReader(tmp_path / "take-1").num_samples("force")


def test_attributes_of_another_take_are_refused(tmp_path):
    make(tmp_path, closed=True)
    other = TAKE.model_copy(update={"operator": "p-08"})
    with SpoolWriter(tmp_path / "other", other, sync=False):
        pass
    shutil.copy(tmp_path / "other" / "recording.json", tmp_path / "take-1")
    with pytest.raises(CorruptDataError, match=r"recording.json is not the one"):
        SpoolReader(tmp_path / "take-1")


def test_what_a_recovery_cuts_off_is_in_the_ledger(tmp_path):
    """A power cut: the last three records never reached the disk, only their places."""
    make(tmp_path, closed=False)
    file = tmp_path / "take-1" / "batches.log"
    data = file.read_bytes()
    places = [at for at in range(len(data)) if data.startswith(b"DXTS", at)]
    start = places[-3]
    # Of the first of them the header did.
    file.write_bytes(data[: start + 40] + bytes(len(data) - start - 40))
    assert recover_spool(tmp_path) == ["take-1"]
    attributes = SpoolReader(tmp_path / "take-1").attributes
    lost = {(e.stream, e.event): e.count for e in attributes.ledger if e.event != "lost"}
    assert lost == {
        ("force", "interrupted"): 1,
        ("camera", "interrupted"): 1,
        ("force", "torn_bytes"): len(data) - start,
        ("camera", "torn_bytes"): len(data) - start,
        ("force", "lost_to_damage"): 1,
    }


def test_a_take_without_a_whole_record_stays(tmp_path):
    """Something was recorded, so it is not removed like a take that never had a sample."""
    for name, size in (("cut", 3), ("torn", 60)):
        make(tmp_path / name, closed=False)
        file = tmp_path / name / "take-1" / "batches.log"
        file.write_bytes(file.read_bytes()[:size])
        assert recover_spool(tmp_path / name) == []
        assert len(file.read_bytes()) == size
        assert "take-1" in Uploader(tmp_path / name, None, period_s=1.0).status()[0].error


def test_a_log_of_another_take_is_not_sent(tmp_path):
    """Takes of one length have logs of one length, whose records differ."""
    make(tmp_path / "a", closed=True)
    make(tmp_path / "b", closed=True, offset_n=0.5)
    log, other = (tmp_path / name / "take-1" / "batches.log" for name in ("a", "b"))
    assert log.stat().st_size == other.stat().st_size
    shutil.copy(other, log)
    store = FakeStore()
    uploader = Uploader(tmp_path / "a", store, period_s=1.0)
    assert uploader.upload_all() == []
    assert store.batches == {}
    assert "its log has other records" in uploader.status()[0].error


def test_an_empty_seal_of_a_spool_of_today_is_damage(tmp_path):
    make(tmp_path, closed=True)
    (tmp_path / "take-1" / "closed").write_bytes(b"")
    with pytest.raises(CorruptDataError, match="'closed' is empty"):
        SpoolReader(tmp_path / "take-1")


def test_a_log_alone_is_reported(tmp_path):
    make(tmp_path, closed=True)
    (tmp_path / "take-1" / "recording.json").unlink()
    uploader = Uploader(tmp_path, FakeStore(), period_s=1.0)
    assert uploader.upload_all() == []
    (status,) = uploader.status()
    assert "recording.json is missing" in status.error
