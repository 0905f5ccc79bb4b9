"""Stress of every stage: checks under numerical hazards, run by the command and as tests."""
