"""What policies and stations import to talk to the services; light on purpose."""
