"""Our own tactile glove on a serial line, which answers commands (docs/device_packets.md)."""
