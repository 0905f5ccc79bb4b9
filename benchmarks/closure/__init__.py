"""Evaluation of retargeting in the twin: human takes replayed by the robot hand."""
