from typing import Any

import numpy as np

def encode_jpeg(
    image: np.ndarray, quality: int = 85, colorspace: str = "RGB", colorsubsampling: str = "444"
) -> bytes: ...
def decode_jpeg(
    data: bytes,
    colorspace: str = "RGB",
    *,
    min_height: int = 0,
    min_width: int = 0,
    min_factor: float = 1,
) -> np.ndarray: ...
def decode_jpeg_header(data: bytes) -> tuple[int, int, str, str]: ...
def is_jpeg(data: bytes) -> bool: ...
