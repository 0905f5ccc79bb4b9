"""The store as a service: takes recordings in batch by batch, gives episodes and windows out."""
