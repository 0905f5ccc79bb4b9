"""Weight files and optimizer loop of the networks of the world model and of the evaluation."""
