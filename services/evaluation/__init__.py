"""Policies, success probes, closed-loop evaluation in worlds, and evaluation reports."""
