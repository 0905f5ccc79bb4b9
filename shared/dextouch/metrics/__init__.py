"""Metrics of predictions, trajectories and policies against ground truth."""
