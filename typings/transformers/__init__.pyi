from typing import Any

from torch import nn

class UMT5EncoderModel(nn.Module):
    config: Any
    @classmethod
    def from_pretrained(cls, folder: str, **options: Any) -> UMT5EncoderModel: ...

class AutoTokenizer:
    @classmethod
    def from_pretrained(cls, folder: str, **options: Any) -> Any: ...
