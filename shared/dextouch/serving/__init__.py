"""Building blocks of every service: application factory, settings, logs, API keys and state."""
