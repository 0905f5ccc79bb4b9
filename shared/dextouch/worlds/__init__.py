"""Worlds in which policies act: the protocol, rollouts, and their HTTP routes."""
