"""Building blocks of the HTTP services: application factory, settings, logging, access, state."""
