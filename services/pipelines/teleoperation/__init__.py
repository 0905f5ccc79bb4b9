"""Live teleoperation: a robot hand that follows a tracked hand, served over a WebSocket."""
