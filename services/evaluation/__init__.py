"""Policies, success classifiers, closed-loop evaluation in worlds, and evaluation reports."""
