"""Compiled retargeting solver, one small least-squares problem for each finger and sample."""
