"""The human skeleton, the robot hand and the 67-D action that both are mapped into."""
