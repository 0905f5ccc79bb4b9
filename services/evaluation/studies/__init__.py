"""Studies: policies scored in a real and in imagined worlds, defined in a file and resumable."""
