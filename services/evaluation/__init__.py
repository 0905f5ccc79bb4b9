"""Policies, success probes, closed-loop evaluation of worlds, and the report about all of it."""
