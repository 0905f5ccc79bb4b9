from typing import Any

from torch import nn

class WanTransformer3DModel(nn.Module):
    patch_embedding: nn.Conv3d
    condition_embedder: Any
    blocks: nn.ModuleList
    norm_out: nn.Module
    proj_out: nn.Linear
    scale_shift_table: nn.Parameter
    def __init__(self, **sizes: Any) -> None: ...

class AutoencoderKLWan(nn.Module):
    def __init__(self, **sizes: Any) -> None: ...
    def encode(self, x: Any, return_dict: bool = ...) -> Any: ...
    def decode(self, z: Any, return_dict: bool = ...) -> Any: ...
