"""Benchmark of rollouts over the network: time per chunk compared with an echo server."""
