"""Numbers that compare what was predicted, reached or imagined with what was true."""
