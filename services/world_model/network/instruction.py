"""Text instructions as inputs of the network: words in a hashed table, or features of UMT5.

Entries of the table start at zero: words that were not trained on have no effect. Features are kept
in memory, in the checkpoint and maybe on disk, so that known ones need no text encoder.
"""

import hashlib
import html
import zlib
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor, nn
from torch.nn.functional import pad

from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError
from services.networks.weight_files import read_tensors, write_tensors
from services.world_model.dynamics.features import MAX_SUBWORDS, WORD, subwords
from services.world_model.network.configuration import NetworkConfig, WanConfig

MAX_WORDS = 16
NO_WORD = 0
NUM_SUBWORD_BUCKETS = 4096
ENCODER_FOLDER: Final = "text_encoder"
TOKENIZER_FOLDER: Final = "tokenizer"
_KEY: Final = "features"
# Texts kept in memory; the oldest makes room.
_MAX_TEXTS: Final = 1024
Value = TypeVar("Value")


def instruction_ids(instruction: str, config: NetworkConfig) -> Int64[Tensor, " ids"]:
    """Buckets of the first 16 words (lower case) or 160 subwords, padded with `NO_WORD`."""
    if config.instruction_encoder == "hashed_words":
        parts = WORD.findall(instruction.lower())[:MAX_WORDS]
        length, num_buckets = MAX_WORDS, config.num_word_buckets
    else:
        parts = subwords(instruction)
        length, num_buckets = MAX_SUBWORDS, NUM_SUBWORD_BUCKETS
    ids = [1 + zlib.crc32(part.encode()) % num_buckets for part in parts]
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
    """Attention pooling of subword embeddings, of which some count more, then two layers."""

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


class TextEncoder:
    """UMT5 encoder and tokenizer in a folder in diffusers' layout; NotFoundError if one lacks."""

    def __init__(self, folder: Path, config: WanConfig) -> None:
        from transformers import AutoTokenizer, UMT5EncoderModel

        for name in (ENCODER_FOLDER, TOKENIZER_FOLDER):
            if not (folder / name).is_dir():
                raise NotFoundError(
                    f"text encoder: no folder {name} in {folder}; copy the whole model in the "
                    "diffusers layout"
                )
        self._config = config
        self._tokenizer: Any = AutoTokenizer.from_pretrained(
            str(folder / TOKENIZER_FOLDER), local_files_only=True
        )
        self._encoder: Any = UMT5EncoderModel.from_pretrained(
            str(folder / ENCODER_FOLDER), local_files_only=True, use_safetensors=True,
            dtype=config.dtype,
        ).eval()  # fmt: skip

    @torch.no_grad()
    def encode(self, text: str) -> Float[Tensor, "words width"]:
        """Features of the text's words and end mark, at most `text_tokens` of them."""
        words = self._tokenizer(
            [text], max_length=self._config.text_tokens, truncation=True,
            return_attention_mask=True, return_tensors="pt",
        )  # fmt: skip
        features: Tensor = self._encoder(words.input_ids, words.attention_mask).last_hidden_state
        return features[0]


class TextFeatures:
    """Features by instruction, from memory, from disk or from the encoder, in this order."""

    def __init__(self, config: WanConfig) -> None:
        self._config = config
        self._folder: Path | None = None
        self._cache: Path | None = None
        self._encoder: TextEncoder | None = None
        self._known: dict[str, Tensor] = {}

    def use(self, folder: Path | None, cache: Path | None = None) -> None:
        """Choose the folders of the pretrained text encoder and of a cache (safetensors)."""
        self._folder, self._cache, self._encoder = folder, cache, None

    def stack(self, texts: Sequence[str]) -> Float[Tensor, "batch words width"]:
        """Features of several texts, padded with zeros to `text_tokens`; raises as `of`."""
        words, dtype = self._config.text_tokens, self._config.dtype
        each = [self.of(text) for text in texts]
        return torch.stack([pad(one.to(dtype), (0, 0, 0, words - len(one))) for one in each])

    def of(self, text: str) -> Float[Tensor, "words width"]:
        """Features of one text.

        Raises:
            InvalidInputError: an unknown text and no encoder.
            CorruptDataError: a damaged file in the cache.
        """
        key = key_of(text)
        if key not in self._known:
            if len(self._known) >= _MAX_TEXTS:
                self._known.pop(next(iter(self._known)))
            self._known[key] = self._stored(key, text).to(self._config.dtype)
        return self._known[key]

    def __deepcopy__(self, _: object) -> "TextFeatures":
        """Itself: copies of a model share their features."""
        return self

    @property
    def known(self) -> Mapping[str, Tensor]:
        """Features in memory, by the key of their text."""
        return self._known

    def learn(self, known: Mapping[str, Tensor]) -> None:
        """Add features; raises CorruptDataError for those of another width."""
        for key, features in known.items():
            self._known[key] = self._checked(features, f"text features {key}")

    def _stored(self, key: str, text: str) -> Tensor:
        file = None if self._cache is None else self._cache / f"{key}.safetensors"
        if file is not None and file.is_file():
            where = f"text features {file.name}"
            tensors, _ = read_tensors(file, where)
            return self._checked(tensors.get(_KEY, torch.empty(0)), where)
        features = self._encode(text)
        if file is not None:
            write_tensors(file, {_KEY: features}, {})
        return features

    def _encode(self, text: str) -> Tensor:
        if self._encoder is None:
            if self._folder is None:
                raise InvalidInputError(
                    f"instruction {text!r}: the checkpoint has no text features of it; use one of "
                    "training, or give the folder of the text encoder (--wan.folder of training, "
                    "--placement.text.folder of serving)"
                )
            self._encoder = TextEncoder(self._folder, self._config)
        return self._encoder.encode(cleaned(text))

    def _checked(self, features: Tensor, where: str) -> Tensor:
        width, longest = self._config.text_width, self._config.text_tokens
        if features.ndim != 2 or features.shape[1] != width or len(features) > longest:
            raise CorruptDataError(
                f"{where}: got shape {tuple(features.shape)}, expected at most {longest} rows of "
                f"{width}; remove the file, or use the cache of this model"
            )
        return features.to(self._config.dtype)


def cleaned(text: str) -> str:
    """Text without HTML entities and repeated spaces, as Wan2.2 is given it."""
    return " ".join(html.unescape(html.unescape(text)).split())


def key_of(text: str) -> str:
    """Key of a text's features: SHA-256 of the cleaned text."""
    return hashlib.sha256(cleaned(text).encode()).hexdigest()


class LastUsed(Generic[Value]):
    """At most `size` values by key; not for several threads."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._values: dict[Hashable, Value] = {}

    def of(
        self, keys: Sequence[Hashable], compute: Callable[[list[int]], Sequence[Value]]
    ) -> list[Value]:
        """Values of the keys; `compute` is given the first index of each key that is not kept."""
        missing = {key: keys.index(key) for key in dict.fromkeys(keys) if key not in self._values}
        made = compute(list(missing.values())) if missing else []
        values = {**self._values, **dict(zip(missing, made, strict=True))}
        used = {key: values.pop(key) for key in dict.fromkeys(keys)}
        self._values = dict([*values.items(), *used.items()][-self._size :])
        return [used[key] for key in keys]
