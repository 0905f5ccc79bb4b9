"""The stage `twin`: time of a chunk by what is asked to be seen and by the solver of physics."""
