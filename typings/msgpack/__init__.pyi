from collections.abc import Callable
from typing import Any

class UnpackException(Exception): ...

def packb(
    o: object,
    *,
    default: Callable[[Any], Any] | None = None,
    use_bin_type: bool = True,
) -> bytes: ...
def unpackb(
    packed: bytes,
    *,
    strict_map_key: bool = True,
    raw: bool = False,
    object_hook: Callable[[dict[Any, Any]], Any] | None = None,
    list_hook: Callable[[list[Any]], Any] | None = None,
    max_array_len: int = -1,
    max_map_len: int = -1,
) -> Any: ...
