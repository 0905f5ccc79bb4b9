"""Bridges: programs that read a tracker's SDK and serve its samples to stations.

A station connects to one as to any bridge (docs/device_packets.md, "Bridges"). Which SDKs there are
and how each is run: docs/sdk_bridges.md.
"""
