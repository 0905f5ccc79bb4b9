"""Metrics of predicted images, touch and policy scores against ground truth."""

__all__ = ["image", "policy", "tactile", "trajectory"]
