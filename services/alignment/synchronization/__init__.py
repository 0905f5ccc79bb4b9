"""Synchronization of streams with clocks of their own to one reference clock and one grid."""
