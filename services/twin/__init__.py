"""The physics twin: two simulated hands and a task in, truth episodes and a world out."""
