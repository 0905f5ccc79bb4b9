"""The station: it reads devices, judges their health, records takes and uploads them."""
