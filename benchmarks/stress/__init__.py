"""Stress tests of every stage: checks under numerical hazards, run by a command and as tests."""
