"""Every HTTP body of the services, as pydantic models that need no web framework."""
