"""Sensor streams: samples, stream descriptors, and the binary encoding of batches."""
