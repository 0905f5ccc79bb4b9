"""Health of a station: faults of its devices and streams, found within about a second.

`CODES` is the table of all that can be found (docs/health.md shows it), `HealthMonitor` evaluates
the streams, and `HealthCollector` shows its report to Prometheus.
"""

from services.acquisition.health.cells import count_taxels
from services.acquisition.health.codes import CODES
from services.acquisition.health.history import (
    NUM_ROWS,
    history_facts,
    json_history,
    packed_history,
)
from services.acquisition.health.metrics import STATION_FIGURES, HealthCollector
from services.acquisition.health.monitor import PERIOD_NS, STATION, TICK_NS, HealthMonitor
from services.acquisition.health.station import DiskCheck, judge_uploads

__all__ = [
    "CODES",
    "NUM_ROWS",
    "PERIOD_NS",
    "STATION",
    "STATION_FIGURES",
    "TICK_NS",
    "DiskCheck",
    "HealthCollector",
    "HealthMonitor",
    "count_taxels",
    "history_facts",
    "json_history",
    "judge_uploads",
    "packed_history",
]
