"""Parts of an instruction's words, which networks read by hashing."""

import re
from typing import Final

# Trigrams of at most 24 words of average length.
MAX_SUBWORDS: Final = 160
WORD: Final = re.compile(r"\w+")


def subwords(instruction: str) -> list[str]:
    """Each word and its trigrams, in lower case with a mark at both ends; at most 160.

    Words of one stem share trigrams, and words that share a bucket by chance differ by theirs.
    """
    parts = []
    for word in WORD.findall(instruction.lower()):
        marked = f"<{word}>"
        parts += [marked, *(marked[i : i + 3] for i in range(len(marked) - 2))]
    return parts[:MAX_SUBWORDS]
