"""Metrics of predicted images, touch and policy scores against ground truth."""

__all__ = [
    "geometry",
    "image",
    "policy",
    "tactile",
    "trajectory",
]
