"""Body of the health history's route, as JSON or packed with its arrays."""

import time
from collections.abc import Mapping

from pydantic_core import to_json

from dextouch.schemas import TakeSpan
from dextouch.streams import pack
from services.acquisition.health.history import STATION_SERIES, STREAM_SERIES, Rows


def history_facts(
    now_ns: int, takes: tuple[TakeSpan, ...], nominal_rate_hz: Mapping[str, float]
) -> dict[str, object]:
    """What a history tells besides its rows (`dextouch.schemas.HealthHistory`).

    Args:
        now_ns: the station's clock.
        takes: of the time of the rows.
        nominal_rate_hz: of the streams that are told.
    """
    return {
        "now_ns": now_ns,
        "now_unix_s": time.time(),
        "takes": [take.model_dump() for take in takes],
        "nominal_rate_hz": dict(nominal_rate_hz),
        "station_series": list(STATION_SERIES),
        "stream_series": list(STREAM_SERIES),
    }


def packed_history(facts: Mapping[str, object], rows: Rows) -> bytes:
    """The facts as fields, and arrays `t_ns`, `station` and `streams` in the order of the facts."""
    return pack(facts, {"t_ns": rows.t_ns, "station": rows.station, "streams": rows.values})


def json_history(facts: Mapping[str, object], rows: Rows) -> bytes:
    """The same as JSON, null where a value is unknown."""
    streams = dict(zip(rows.streams, rows.values.tolist(), strict=True))
    body = {"t_ns": rows.t_ns.tolist(), "station": rows.station.tolist(), "streams": streams}
    return to_json(dict(facts) | body, inf_nan_mode="null")
