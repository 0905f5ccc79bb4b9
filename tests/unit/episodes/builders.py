"""Small made-up episodes and recordings for the tests of the store."""
