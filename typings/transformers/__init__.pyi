from typing import Any

from torch import nn

class UMT5EncoderModel(nn.Module):
    config: Any
    def __init__(self, config: UMT5Config) -> None: ...
    @classmethod
    def from_pretrained(cls, folder: str, **options: Any) -> UMT5EncoderModel: ...

class AutoTokenizer:
    @classmethod
    def from_pretrained(cls, folder: str, **options: Any) -> Any: ...

class UMT5Config:
    def __init__(self, **sizes: Any) -> None: ...
