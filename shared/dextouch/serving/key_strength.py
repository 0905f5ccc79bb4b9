"""Strength of API keys: short, repetitive, orderly and published ones are refused at the start."""

import math
from typing import Final

MIN_LENGTH: Final = 16
# So many guesses take 35 years at a thousand a second. By this estimate 97 of 100 random keys of 16
# hexadecimal digits have as many, and all of 32 digits: the least of 20,000 had 75.
MIN_BITS: Final = 40
# Neighbours in these rows, in both directions, are orderly, as are those in the alphabet.
KEYBOARD_ROWS: Final = ("1234567890", "qwertyuiop", "asdfghjkl", "zxcvbnm")
# Keys that documentation of this or an earlier release showed.
PUBLISHED: Final = frozenset({"16 characters or more", "the-key-of-the-store"})
# Of a repetition; shorter ones also occur in random keys.
REPEATED: Final = 3
# A character is orderly if it follows the last one, or the last but one as in "a1b2c3d4".
LAGS: Final = (1, 2)
HOW_TO: Final = "make a key with: openssl rand -hex 32"


def check_strength(key: str) -> None:
    """Raise ValueError, which does not repeat the key, if a key is easy to guess."""
    if len(key) < MIN_LENGTH:
        raise ValueError(f"got {len(key)} characters, expected at least {MIN_LENGTH}; {HOW_TO}")
    if key.lower() in PUBLISHED:
        raise ValueError(f"got a key that is printed in the documentation; {HOW_TO}")
    if (bits := estimated_bits(key)) < MIN_BITS:
        raise ValueError(
            f"got a key that repeats itself or goes in order (about {bits:.0f} bits), expected at "
            f"least {MIN_BITS}; {HOW_TO}"
        )


def estimated_bits(key: str) -> float:
    """How many bits a key has at most: those of each character that does not follow from others.

    A character follows from others if it ends three characters that occur earlier, or goes on a
    series: steps of at most one in the alphabet, the digits or a row of the keyboard.
    """
    text = key.lower()
    num_free = sum(not _follows(text, index) for index in range(len(text)))
    return num_free * math.log2(max(1, len(set(text))))


def _follows(text: str, index: int) -> bool:
    last = text[max(0, index + 1 - REPEATED) : index + 1]
    if len(last) == REPEATED and last in text[:index]:
        return True
    # A single step could be chance.
    return any(
        index > lag and _is_step(text, index, lag) and _is_step(text, index - 1, lag)
        for lag in LAGS
    )


def _is_step(text: str, index: int, lag: int) -> bool:
    """Whether a character is next to an earlier one, or the same."""
    before, after = text[index - lag], text[index]
    is_near = abs(ord(after) - ord(before)) <= 1
    return is_near or any(before + after in row or after + before in row for row in KEYBOARD_ROWS)
