"""Wuji's tactile glove on a serial line: 24 × 32 cells, no commands."""
