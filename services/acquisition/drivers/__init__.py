"""Drivers: a transport's bytes come in, timed samples in SI units and honest counters go out."""
