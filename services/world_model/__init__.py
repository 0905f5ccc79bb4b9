"""The world model: learns joint futures of sight and touch from episodes and serves them."""
