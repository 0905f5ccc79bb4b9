"""Policies that act on observations: still, replayed, and learned by behaviour cloning."""
