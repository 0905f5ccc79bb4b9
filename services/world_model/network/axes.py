"""Splitting one axis of a tensor into several."""

from torch import Tensor


def split_axis(tensor: Tensor, axis: int, sizes: tuple[int, ...]) -> Tensor:
    """Split one axis into several; one size may be -1. Typed, unlike `Tensor.unflatten`."""
    axis = axis % tensor.ndim
    return tensor.reshape(*tensor.shape[:axis], *sizes, *tensor.shape[axis + 1 :])
