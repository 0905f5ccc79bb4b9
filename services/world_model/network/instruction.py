"""Embedding of a text instruction as one vector.

Words are hashed into a small table, so that any text is accepted without a vocabulary. Entries
start at zero: words that were not trained on have no effect.
"""

import re
import zlib

import torch
from jaxtyping import Float32, Int64
from torch import Tensor, nn

MAX_WORDS = 16
NO_WORD = 0
_WORD = re.compile(r"\w+")


def hash_words(instruction: str, num_buckets: int) -> Int64[Tensor, " max_words"]:
    """Bucket of each of the first 16 words (lower case), padded with `NO_WORD`."""
    words = _WORD.findall(instruction.lower())[:MAX_WORDS]
    buckets = [1 + zlib.crc32(word.encode()) % num_buckets for word in words]
    return torch.tensor(buckets + [NO_WORD] * (MAX_WORDS - len(buckets)), dtype=torch.int64)


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
