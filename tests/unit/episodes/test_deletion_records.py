"""What a store remembers of deletions: enough to recognise takes, and no operator's name."""

from datetime import UTC, datetime, timedelta

import pytest

from dextouch.episodes.maintenance import DeletionRecords, TakeFacts, take_start
from dextouch.errors import ConflictError, CorruptDataError

GONE = "Zoë-7"
BEGAN = datetime(2026, 5, 4, 12, tzinfo=UTC)


def take(recording_id="take-1", station="desk_1", *, began=BEGAN, operator=None, **changes):
    fields = {"started": take_start(began, 5), "operator": operator, "started_at": began}
    return TakeFacts(recording_id, station, **fields | changes)


@pytest.fixture
def records(tmp_path):
    return DeletionRecords(tmp_path)


def delete(records, *takes, operator=GONE):
    key = records.key_of(operator=operator)
    records.add(key, takes, operator=operator)
    return key


def names(left):
    return {one.station: one.recordings for one in left}


def test_no_file_names_the_operator(records, tmp_path):
    key = delete(records, take(), take(f"take-of-{GONE.lower()}"))
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(files) == 2
    for path in files:
        assert GONE.lower() not in str(path).lower()
        text = path.read_bytes().decode(errors="replace").lower()
        assert GONE.lower() not in text
        assert "zo\\u00eb" not in text
    # The id that has the name in it is recognised all the same, and shown by another.
    assert records.find(take(f"take-of-{GONE.lower()}")) is not None
    (shown,) = names(records.outstanding(key)).values()
    assert "take-1" in shown
    assert len(shown) == 2


def test_other_stores_hash_the_same_name_to_something_else(tmp_path):
    keys = {DeletionRecords(tmp_path / name).key_of(operator=GONE) for name in "ab"}
    assert len(keys) == 2


@pytest.mark.parametrize(
    ("other", "is_covered"),
    [
        (take(), True),
        (take(station="desk_2"), False),
        (take("take-2"), False),
        (take(began=BEGAN + timedelta(seconds=1)), False),
        # Another zone's words for the same time.
        (take(began=BEGAN.astimezone()), True),
        (take("take-2", operator=GONE), True),
        (take("take-2", operator=GONE + "8"), False),
        (take("take-2", operator=GONE, began=None), True),
        (take(is_damaged=True, started="None/None"), True),
        (take("take-2", is_damaged=True, started="None/None"), False),
    ],
)
def test_takes_that_a_deletion_covers(records, other, is_covered):
    delete(records, take())
    assert (records.find(other) is not None) is is_covered


def test_a_take_of_a_deleted_recording_is_covered_whoever_recorded_it(records):
    key = records.key_of(operator=None, recording="take-1")
    records.add(key, [take()], operator=None)
    assert records.find(take(operator="somebody")).key == key
    assert records.find(take("take-2", operator="somebody")) is None


def test_what_began_after_the_deletion_is_told_apart_until_it_is_repeated(records):
    delete(records)
    later = take(operator=GONE, began=datetime.now(UTC) + timedelta(milliseconds=1))
    assert records.find(later).is_later
    while datetime.now(UTC) <= later.started_at:
        pass
    delete(records)
    assert not records.find(later).is_later


def test_a_readmitted_operator_may_record_and_the_deleted_takes_stay_deleted(records):
    delete(records, take())
    assert records.has_operator(GONE)
    assert records.readmit(GONE) == 1
    assert not records.has_operator(GONE)
    assert records.find(take("take-2", operator=GONE)) is None
    assert records.find(take(operator=GONE)) is not None
    assert records.readmit("nobody") == 0


def test_outstanding_shrinks_by_what_stations_confirm(records, tmp_path):
    key = delete(records, take(), take("take-2"), take("take-3", "desk_2"))
    service = DeletionRecords(tmp_path)
    assert names(service.outstanding(key)) == {
        "desk_1": ("take-1", "take-2"),
        "desk_2": ("take-3",),
    }
    service.confirm("desk_1", revision=service.revision, held={key: ["take-2"]})
    assert names(records.outstanding(key)) == {"desk_1": ("take-2",), "desk_2": ("take-3",)}
    service.confirm("desk_1", revision=service.revision, held={})
    assert names(records.outstanding(key)) == {"desk_2": ("take-3",)}


def test_a_station_that_is_known_may_hold_takes_that_the_store_never_had(records):
    first = delete(records, operator="first")
    records.confirm("desk_9", revision=records.revision, held={})
    assert records.outstanding(first) == ()
    second = delete(records, operator="second")
    (left,) = records.outstanding(second)
    assert (left.station, left.recordings, left.has_answered) == ("desk_9", (), False)


def test_a_confirmation_of_before_a_deletion_is_refused(records, tmp_path):
    key = delete(records, take())
    old = records.revision
    # By the command line, beside the running service.
    delete(DeletionRecords(tmp_path), operator="another")
    with pytest.raises(ConflictError, match="another deletion"):
        records.confirm("desk_1", revision=old, held={})
    assert names(records.outstanding(key)) == {"desk_1": ("take-1",)}


def test_a_repeated_deletion_keeps_what_the_first_knew(records):
    key = delete(records, take())
    records.confirm("desk_1", revision=records.revision, held={})
    assert delete(records, take("take-2")) == key
    assert records.find(take()).key == key
    # The station is asked again: what it confirmed was the deletion of before.
    assert names(records.outstanding(key)) == {"desk_1": ("take-1", "take-2")}


def test_a_damaged_record_lets_nobody_back_in(records, tmp_path):
    key = delete(records, take())
    (tmp_path / ".deleted" / "records" / f"{key}.json").write_text("{")
    with pytest.raises(CorruptDataError, match="backup"):
        DeletionRecords(tmp_path).find(take("other", operator="somebody"))
