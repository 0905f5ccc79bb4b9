"""A robot's state server on a TCP socket."""
