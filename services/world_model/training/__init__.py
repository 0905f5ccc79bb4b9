"""Training of world models: windows of episodes, losses, training loops and evaluation."""
