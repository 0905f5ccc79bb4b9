"""Policies that act on observations: hold, replay, behaviour cloning, visual servo and custom."""
