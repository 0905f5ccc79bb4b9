"""The station: it reads devices, monitors their health, records takes and uploads them."""
