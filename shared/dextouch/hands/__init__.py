"""Hand models: tracked human skeleton, robot hand kinematics, and the 67-D action space."""
