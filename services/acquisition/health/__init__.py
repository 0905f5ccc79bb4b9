"""Health of a station: faults of its devices and streams, found within about a second.

`codes` is the table of all that can be found (docs/health.md shows it), `monitor` evaluates the
streams, and `metrics` shows the report to Prometheus.
"""
