"""Bytes in any portions come in; what a family's own rules call a frame goes out, one by one."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, TypeVar

Found = TypeVar("Found")


@dataclass
class DecoderStatistics:
    """What a decoder has seen; `lost` counts by sequence numbers, between first and last.

    `suspects` are packets that were held back although all that their family checks held: their
    numbers cannot be readings.
    """

    packets: int = 0
    crc_errors: int = 0
    length_errors: int = 0
    resync_bytes: int = 0
    lost: int = 0
    repeated: int = 0
    restarts: int = 0
    refused: int = 0
    suspects: int = 0


class SequenceCounter:
    """Counts lost packets, repetitions and restarts by a sequence number of so many bits."""

    def __init__(self, statistics: DecoderStatistics, *, bits: int) -> None:
        self._statistics = statistics
        self._modulus = 1 << bits
        self._last: int | None = None

    def count(self, sequence: int, *, is_restarted: bool = False) -> None:
        """One packet came.

        Args:
            sequence: its number.
            is_restarted: the device's clock says that it started anew, so the number may be any.
        """
        statistics = self._statistics
        statistics.packets += 1
        if self._last is not None:
            step = (sequence - self._last) % self._modulus
            if is_restarted:
                statistics.restarts += 1
            elif step == 0:
                statistics.repeated += 1
            elif step < self._modulus // 2:
                statistics.lost += step - 1
            else:
                statistics.restarts += 1
        self._last = sequence


class FrameSearch(ABC, Generic[Found]):
    """Looks for frames that begin with a mark; the result does not depend on the portions.

    Where a frame does not hold, the search goes on one byte further, never behind the claimed
    frame, so that a damaged one costs only itself.

    Args:
        mark: the bytes that every frame begins with.
    """

    def __init__(self, mark: bytes) -> None:
        self.statistics = DecoderStatistics()
        self._mark = mark
        self._buffer = bytearray()
        self._needed = 0

    def reset(self) -> None:
        """Forget half a frame (the link was lost); counters and sequence stay."""
        self.statistics.resync_bytes += len(self._buffer)
        self._buffer.clear()
        self._needed = 0

    def feed(self, data: bytes) -> list[Found]:
        """Frames completed by `data`."""
        buffer = self._buffer
        buffer += data
        if len(buffer) < self._needed:
            return []
        self._needed = 0
        found: list[Found] = []
        position = 0
        while True:
            position = self._seek(position)
            if len(buffer) < position + len(self._mark):
                break
            taken = self._take(position)
            if taken is not None:
                found.append(taken[0])
                position += taken[1]
            elif self._needed:
                break
            else:
                position += 1
                self.statistics.resync_bytes += 1
        del buffer[:position]
        self._needed = max(0, self._needed - position)
        return found

    def _seek(self, position: int) -> int:
        found = self._buffer.find(self._mark, position)
        if found < 0:
            found = max(position, len(self._buffer) - len(self._mark) + 1)
        self.statistics.resync_bytes += found - position
        return found

    @abstractmethod
    def _take(self, position: int) -> tuple[Found, int] | None:
        """The frame at `position` and its size; None when there is none, or not yet.

        In the latter case `_needed` is set to the length that the buffer must have first.
        """
