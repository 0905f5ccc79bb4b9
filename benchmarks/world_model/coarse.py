"""Models whose matrix products are in bfloat16, which no served world has, for comparisons."""

import copy
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from services.world_model.checkpoints import Checkpoint
from services.world_model.network.model import products_in


def with_coarse_products(checkpoint: Checkpoint) -> Checkpoint:
    """A copy whose experts multiply in bfloat16 (autocast); its codecs stay exact."""
    model = copy.deepcopy(checkpoint.model)
    for name in ("context", "clean_tokens", "denoise"):
        setattr(model, name, partial(_coarse, getattr(model, name)))
    return replace(checkpoint, model=model)


def _coarse(method: Callable[..., Any], *arguments: object) -> Any:  # noqa: ANN401 - the method's
    with products_in("bfloat16", "cpu"):
        return method(*arguments)
