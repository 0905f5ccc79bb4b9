"""Head images drawn from a state: what the world model shows of a future that it imagined."""
