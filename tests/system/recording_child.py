"""A station process to be killed: records mock devices and says which samples are acknowledged."""

import sys
from pathlib import Path

from dextouch.schemas import TakePrompt
from services.acquisition.clock import StationClock
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.pattern import pattern_streams


def main(spool: str, seed: str) -> None:
    """Record until killed."""
    mock = MockStation(
        pattern_streams(),
        FaultScript.first_light(),
        int(seed),
        StationClock(),
        spool_root=Path(spool),
    )
    mock.start()
    mock.play_forever()
    recorder = mock.station.recorder
    recorder.arm(TakePrompt(task="stack_bowls", instruction="stack the bowls"))
    recorder.record(f"take-{seed}")
    while True:
        counts = recorder.status().num_samples
        print(*(f"{name}={count}" for name, count in counts.items()), flush=True)  # noqa: T201


if __name__ == "__main__":
    main(*sys.argv[1:])
