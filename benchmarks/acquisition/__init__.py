"""Benchmark of acquisition: glove decoders and serial ports."""
