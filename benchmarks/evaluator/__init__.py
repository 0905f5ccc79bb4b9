"""Stage `evaluator`: reliability of the success that a world model imagines."""
