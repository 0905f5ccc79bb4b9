"""The paper's tables in miniature: `python -m benchmarks reproduction`."""
