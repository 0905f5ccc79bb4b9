"""Stage `evaluator`: whether success that a world model imagines can be believed."""
