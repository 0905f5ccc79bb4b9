"""Samples of a sensor stream, what a stream is, and how batches of samples become bytes."""
