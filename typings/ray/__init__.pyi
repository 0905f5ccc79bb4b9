# Ray is an extra of its own (scale), which is not installed beside the type checker.
