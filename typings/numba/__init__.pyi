from collections.abc import Callable
from typing import Literal, TypeVar

from numba import config as config

_F = TypeVar("_F", bound=Callable[..., object])

def njit(
    *,
    cache: bool = ...,
    nogil: bool = ...,
    error_model: Literal["python", "numpy"] = ...,
    fastmath: bool | set[str] = ...,
) -> Callable[[_F], _F]: ...
