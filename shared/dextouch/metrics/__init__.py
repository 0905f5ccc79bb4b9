"""Metrics of predicted images, touch and policy scores against ground truth."""
