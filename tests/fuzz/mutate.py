"""Mutate packets for as long as asked, guided by the lines of code that they reach.

`python -m tests.fuzz.mutate --seconds 60` keeps every input that takes the decoders through a
pair of lines not seen before and mutates it further. Each input is decoded whole and in pieces:
an exception other than a refused device, or a difference, is a defect, and so is a packet with a
checksum that nobody made. The input is written to a file, and the run ends with status 1.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from dextouch.errors import DeviceError
from tests.fuzz.glove_families import FAMILIES, content

MAX_BYTES = 20_000
WATCHED = str(Path("services") / "acquisition" / "drivers")


class Coverage:
    """Pairs of lines in the drivers that followed each other."""

    def __init__(self):
        self.seen = set()
        self._new = set()
        self._last = None

    def __enter__(self):
        self._new, self._last = set(), None
        sys.settrace(self._on_call)
        return self

    def __exit__(self, *error):
        sys.settrace(None)

    def keep(self):
        """Whether the last run saw something new; remembers it."""
        fresh = self._new - self.seen
        self.seen |= fresh
        return bool(fresh)

    def _on_call(self, frame, event, argument):
        del event, argument
        return self._on_line if WATCHED in frame.f_code.co_filename else None

    def _on_line(self, frame, event, argument):
        del argument
        if event == "line":
            place = (frame.f_code.co_name, frame.f_lineno)
            self._new.add((self._last, place))
            self._last = place
        return self._on_line


def mutate(data, rng, others):
    """One to four edits: flip, drop, insert, repeat, swap halves, splice another input."""
    mutated = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        at, to = sorted(rng.integers(0, len(mutated) + 1, 2)) if mutated else (0, 0)
        kind = int(rng.integers(6))
        if kind == 0 and at < len(mutated):
            mutated[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            del mutated[at : min(to, at + int(rng.integers(1, 60)))]
        elif kind == 2:
            mutated[at:at] = rng.bytes(int(rng.integers(1, 9)))
        elif kind == 3:
            mutated[at:at] = mutated[at:to]
        elif kind == 4:
            mutated = mutated[at:] + mutated[:at]
        else:
            mutated[at:to] = others[int(rng.integers(len(others)))][: int(rng.integers(1, 4000))]
    return bytes(mutated[:MAX_BYTES])


def decode(family, data, sizes):
    """Contents in order, and the message of a refusal."""
    decoder, found, position, turn = family.decoder(), [], 0, 0
    while position < len(data):
        size = sizes[turn % len(sizes)]
        turn += 1
        try:
            found += [content(item) for item in decoder.feed(data[position : position + size])]
        except DeviceError as error:
            return found, error.message
        position += size
    return found, None


def check(family, data, made, rng, coverage):
    """What is wrong with how this input is decoded; None if nothing is."""
    with coverage:
        whole, refusal = decode(family, data, [max(1, len(data))])
    sizes = [int(size) for size in rng.integers(1, 900, 7)]
    cut, cut_refusal = decode(family, data, sizes)
    if refusal != cut_refusal or (refusal is None and whole != cut):
        return f"portions {sizes} change the packets"
    if family.has_checksum and any(item not in made for item in whole):
        return "a packet that nobody made"
    return None


def fuzz(name, seconds, seed):
    """Fuzz one family; None, or the defect and its input."""
    family = FAMILIES[name]
    rng = np.random.default_rng(seed)
    coverage = Coverage()
    made, corpus = set(), []
    for start in (0, 65_534):
        pairs = [family.make(start + index, rng) for index in range(3)]
        made |= {values for _, values in pairs}
        corpus.append(b"".join(packet for packet, _ in pairs))
    end_s = time.monotonic() + seconds
    runs = 0
    while time.monotonic() < end_s:
        data = mutate(corpus[int(rng.integers(len(corpus)))], rng, corpus)
        defect = check(family, data, made, rng, coverage)
        runs += 1
        if defect is not None:
            return defect, data
        if coverage.keep():
            corpus.append(data)
    sys.stdout.write(
        f"{name}: {runs} inputs, {len(corpus)} kept, {len(coverage.seen)} pairs of lines, fine\n"
    )
    return None


def main():
    """Fuzz all families, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="for each family")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/fuzz"))
    options = parser.parse_args()
    for name in sorted(FAMILIES):
        defect = fuzz(name, options.seconds, options.seed)
        if defect is not None:
            options.out.mkdir(parents=True, exist_ok=True)
            path = options.out / f"{name}.bin"
            path.write_bytes(defect[1])
            sys.stdout.write(f"{name}: {defect[0]}; the input is {path}\n")
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
