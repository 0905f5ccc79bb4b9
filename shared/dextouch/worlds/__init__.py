"""Worlds in which policies act: the protocol, its rollouts and their HTTP routes."""
