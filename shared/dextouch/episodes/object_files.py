"""Cached range reads of the files of a group in a bucket."""

import threading

from dextouch.episodes.object_bucket import Bucket, ObjectFacts

# Small enough for a window of images, large enough that a request is worth its round trip.
BLOCK_BYTES = 1 << 18
# One request for the end of a file gives its size, the index of its shard, and all of a small one.
TAIL_BYTES = 1 << 16
# Sequential reads get ever larger requests, up to this many blocks.
MAX_READ_AHEAD = 8
_TAIL = -1


class ObjectFile:
    """One object, read by ranges through the bucket's cache."""

    def __init__(self, bucket: Bucket, key: str) -> None:
        self._bucket, self._key = bucket, key
        # Held during a request: a second reader then finds the first one's blocks in the cache.
        self._guard = threading.Lock()
        self._facts: ObjectFacts | None = None
        self._next_block, self._ahead = -1, 1

    def __reduce__(self) -> tuple[type["ObjectFile"], tuple[Bucket, str]]:
        return ObjectFile, (self._bucket, self._key)

    def size(self) -> int | None:
        """Length in bytes; None if the object does not exist."""
        with self._guard:
            facts = self._look()
        return None if facts is None else facts.size

    def read(self, offset: int, length: int) -> bytes:
        """Bytes offset … offset + length − 1; fewer where the object ends before.

        Raises:
            StorageError, UnavailableError: see `Bucket.read`.
        """
        with self._guard:
            facts = self._look()
            if facts is None:
                return b""
            stop = min(offset + length, facts.size)
            if stop <= offset:
                return b""
            if self._bucket.cache.capacity == 0:
                return self._bucket.read(facts, offset, stop)
            tail_start = max(0, facts.size - TAIL_BYTES)
            if offset >= tail_start:
                return self._tail(facts, tail_start)[offset - tail_start : stop - tail_start]
            return self._from_blocks(facts, offset, stop)

    def _look(self) -> ObjectFacts | None:
        if self._facts is None:
            found = self._bucket.tail(self._key, TAIL_BYTES)
            if found is None:
                return None
            self._facts = found[0]
            self._keep(self._facts, _TAIL, found[1])
        return self._facts

    def _tail(self, facts: ObjectFacts, start: int) -> bytes:
        data = self._known(facts, _TAIL)
        if data is None:
            data = self._bucket.read(facts, start, facts.size)
            self._keep(facts, _TAIL, data)
        return data

    def _from_blocks(self, facts: ObjectFacts, offset: int, stop: int) -> bytes:
        first, last = offset // BLOCK_BYTES, (stop - 1) // BLOCK_BYTES
        blocks = {n: self._known(facts, n) for n in range(first, last + 1)}
        missing = [number for number, block in blocks.items() if block is None]
        if missing:
            blocks |= self._fetch(facts, missing[0], missing[-1] + 1)
        data = b"".join(blocks[number] or b"" for number in range(first, last + 1))
        return data[offset - first * BLOCK_BYTES : stop - first * BLOCK_BYTES]

    def _fetch(self, facts: ObjectFacts, first: int, stop: int) -> dict[int, bytes]:
        """Blocks first … stop−1 and perhaps some after them, with one request."""
        self._ahead = min(2 * self._ahead, MAX_READ_AHEAD) if first == self._next_block else 1
        num_blocks = -(-facts.size // BLOCK_BYTES)
        stop = min(max(stop, first + self._ahead), num_blocks)
        self._next_block = stop
        start = first * BLOCK_BYTES
        data = self._bucket.read(facts, start, min(stop * BLOCK_BYTES, facts.size))
        blocks = {
            number: data[number * BLOCK_BYTES - start : (number + 1) * BLOCK_BYTES - start]
            for number in range(first, stop)
        }
        for number, block in blocks.items():
            self._keep(facts, number, block)
        return blocks

    def _known(self, facts: ObjectFacts, number: int) -> bytes | None:
        return self._bucket.cache.get((facts.key, facts.etag, number))

    def _keep(self, facts: ObjectFacts, number: int, block: bytes) -> None:
        self._bucket.cache.put((facts.key, facts.etag, number), block)


class ObjectGroup:
    """The files of a committed group in a bucket, below the prefix `episodes/ID`.

    `known` are the contents of files that were read already, by name.
    """

    def __init__(self, bucket: Bucket, folder: str, known: dict[str, bytes]) -> None:
        self._bucket, self._folder, self._known = bucket, folder, known

    @property
    def item_id(self) -> str:
        """Id of the group."""
        return self._folder.rpartition("/")[2]

    def get(self, name: str) -> bytes | None:
        """Contents of a small file; None if it does not exist."""
        if name in self._known:
            return self._known[name]
        return self._bucket.get(f"{self._folder}/{name}")

    def source(self, name: str) -> ObjectFile:
        """A file for range reads."""
        return ObjectFile(self._bucket, f"{self._folder}/{name}")
