"""Building blocks of services: application factory, settings, logging, access, state, processes."""
