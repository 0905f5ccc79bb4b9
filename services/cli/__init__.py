"""The command line: the one place that may know every service."""
