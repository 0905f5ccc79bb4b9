"""HTTP bodies of the services as pydantic models, independent of the web framework."""
