"""Parts of objects: slices of them, few requests, and a memory that stays within its bounds."""

from datetime import UTC, datetime

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dextouch.episodes.bucket_storage import (
    BLOCK_BYTES,
    MAX_READ_AHEAD,
    TAIL_BYTES,
    ObjectFile,
)
from dextouch.episodes.s3_bucket import Bucket, LruCache, ObjectFacts


class CountedBucket(Bucket):
    """Objects in memory with the two requests that reading makes, counted."""

    def __init__(self, data, capacity):
        self.data, self.requests, self.cache = data, [], LruCache(capacity)

    def tail(self, key, length):
        self.requests.append(("tail", length))
        facts = ObjectFacts(key, len(self.data), "e", datetime.now(UTC))
        return facts, self.data[max(0, len(self.data) - length) :]

    def read(self, facts, start, stop):
        assert 0 <= start < stop <= facts.size
        self.requests.append((start, stop))
        return self.data[start:stop]


DATA = np.random.default_rng(5).bytes(3 * BLOCK_BYTES + TAIL_BYTES + 12_345)
NEAR = st.sampled_from([0, BLOCK_BYTES, 2 * BLOCK_BYTES, len(DATA) - TAIL_BYTES, len(DATA)])
SPANS = st.lists(
    st.tuples(NEAR, st.integers(-70_000, 70_000), st.integers(0, 600_000)), min_size=1, max_size=8
)


@given(SPANS, st.sampled_from([0, 100_000, BLOCK_BYTES, 1 << 30]))
def test_parts_of_an_object_are_slices_of_it(spans, capacity):
    bucket = CountedBucket(DATA, capacity)
    file = ObjectFile(bucket, "k")
    assert file.size() == len(DATA)
    for near, shift, length in spans:
        offset = max(0, near + shift)
        assert file.read(offset, length) == DATA[offset : offset + length]
        assert sum(map(len, bucket.cache._values.values())) == bucket.cache._size <= capacity


def test_what_was_read_is_not_asked_for_again():
    bucket = CountedBucket(DATA, 1 << 30)
    file = ObjectFile(bucket, "k")
    for _ in range(3):
        file.read(0, 10)
        file.read(BLOCK_BYTES - 10, 20)
        file.read(len(DATA) - 10, 10)
    assert bucket.requests[0] == ("tail", TAIL_BYTES)
    # Two neighbouring blocks at most, each once.
    assert len(bucket.requests) <= 3
    other = ObjectFile(bucket, "another key")
    other.read(0, 10)
    assert bucket.requests[-1][0] == 0


def test_small_files_come_whole_with_one_request():
    bucket = CountedBucket(b"0123456789", 1 << 20)
    file = ObjectFile(bucket, "k")
    assert file.size() == 10
    assert (file.read(0, 4), file.read(8, 2), file.read(10, 5)) == (b"0123", b"89", b"")
    assert bucket.requests == [("tail", TAIL_BYTES)]


def test_reading_on_asks_for_more_at_a_time():
    data = bytes(64 * BLOCK_BYTES)
    bucket = CountedBucket(data, 1 << 30)
    file = ObjectFile(bucket, "k")
    for offset in range(0, len(data), 50_000):
        file.read(offset, 50_000)
    reads = [stop - start for start, stop in bucket.requests[1:]]
    assert max(reads) == MAX_READ_AHEAD * BLOCK_BYTES
    assert len(reads) <= 64 / MAX_READ_AHEAD + 4
    # What is scattered is not met with more than is asked for.
    bucket = CountedBucket(data, 1 << 30)
    file = ObjectFile(bucket, "k")
    for number in (40, 10, 50, 20):
        file.read(number * BLOCK_BYTES, 100)
    assert {stop - start for start, stop in bucket.requests[1:]} == {BLOCK_BYTES}
