"""Embedding of a text instruction as one vector.

Words, or their parts, are hashed into a table, so that any text is accepted without a vocabulary.
Entries start at zero: words that were not trained on have no effect.
"""

import re
import zlib
from typing import Literal

import torch
from jaxtyping import Float32, Int64
from torch import Tensor, nn

InstructionKind = Literal["hashed_words", "subwords"]
MAX_WORDS = 16
NO_WORD = 0
# Trigrams of at most 24 words of average length.
MAX_SUBWORDS = 160
NUM_SUBWORD_BUCKETS = 4096
_WORD = re.compile(r"\w+")


def instruction_ids(
    instruction: str, kind: InstructionKind, *, num_buckets: int
) -> Int64[Tensor, " ids"]:
    """Buckets of an instruction's words or subwords, padded with `NO_WORD` to a fixed length."""
    if kind == "hashed_words":
        return hash_words(instruction, num_buckets)
    return hash_subwords(instruction)


def hash_words(instruction: str, num_buckets: int) -> Int64[Tensor, " max_words"]:
    """Bucket of each of the first 16 words (lower case), padded with `NO_WORD`."""
    words = _WORD.findall(instruction.lower())[:MAX_WORDS]
    return _padded([_bucket(word, num_buckets) for word in words], MAX_WORDS)


def hash_subwords(instruction: str) -> Int64[Tensor, " max_subwords"]:
    """Bucket of each word and of its trigrams, in lower case with a mark at both ends.

    Words of one stem share trigrams, and words that share a bucket by chance differ by theirs.
    """
    parts = []
    for word in _WORD.findall(instruction.lower()):
        marked = f"<{word}>"
        parts += [marked, *(marked[i : i + 3] for i in range(len(marked) - 2))]
    ids = [_bucket(part, NUM_SUBWORD_BUCKETS) for part in parts[:MAX_SUBWORDS]]
    return _padded(ids, MAX_SUBWORDS)


def _bucket(text: str, num_buckets: int) -> int:
    return 1 + zlib.crc32(text.encode()) % num_buckets


def _padded(ids: list[int], length: int) -> Int64[Tensor, " length"]:
    return torch.tensor(ids + [NO_WORD] * (length - len(ids)), dtype=torch.int64)


class InstructionEncoder(nn.Module):
    """Mean of the word embeddings and a linear map; an empty instruction gives the bias."""

    def __init__(self, *, num_buckets: int, word_width: int, width: int) -> None:
        super().__init__()
        self.table = nn.Embedding(num_buckets + 1, word_width, padding_idx=NO_WORD)
        nn.init.zeros_(self.table.weight)
        self.project = nn.Linear(word_width, width)

    def forward(self, words: Int64[Tensor, "batch max_words"]) -> Float32[Tensor, "batch width"]:
        """One vector per instruction."""
        count = (words != NO_WORD).sum(dim=1, keepdim=True).clamp_min(1)
        return self.project(self.table(words).sum(dim=1) / count)


class SubwordEncoder(nn.Module):
    """Attention pooling of subword embeddings, then two layers.

    The weights of the pooling let the few words that tell instructions apart count more than the
    many that they share. An empty instruction gives the value of no words.
    """

    def __init__(self, *, word_width: int, width: int) -> None:
        super().__init__()
        self.table = nn.Embedding(NUM_SUBWORD_BUCKETS + 1, word_width, padding_idx=NO_WORD)
        self.scores = nn.Embedding(NUM_SUBWORD_BUCKETS + 1, 1, padding_idx=NO_WORD)
        nn.init.zeros_(self.table.weight)
        nn.init.zeros_(self.scores.weight)
        self.project = nn.Sequential(
            nn.Linear(word_width, width), nn.SiLU(), nn.Linear(width, width)
        )

    def forward(self, ids: Int64[Tensor, "batch ids"]) -> Float32[Tensor, "batch width"]:
        """One vector per instruction."""
        present = (ids != NO_WORD).float()
        # Bounded scores, so that no exponential overflows.
        weights = (5.0 * torch.tanh(self.scores(ids)[..., 0])).exp() * present
        total = weights.sum(dim=1, keepdim=True).clamp_min(1e-9)
        return self.project((weights / total)[:, None] @ self.table(ids)).squeeze(1)
