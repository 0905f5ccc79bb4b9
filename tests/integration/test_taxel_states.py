"""Taxels out of order that the fault script plants are marked with their state, and no others."""

import pytest

from dextouch.schemas import TakePrompt
from services.acquisition.clock import VirtualClock
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import DeviceFaults, FaultScript
from services.acquisition.mocks.pattern import pattern_streams

PROMPT = TakePrompt(task="stack_bowls", instruction="stack the bowls")
NUM_ROUNDS = 4
# (row, column) of the palm, below the bump that wanders around it, and far from each other.
PLANTED = {
    "dead": [(3, 7), (11, 8)],
    "stuck": [(7, 2), (7, 12)],
    "saturated": [(0, 0), (10, 4)],
    "drifted": [(14, 15), (3, 12)],
}
STATES = {"drifted": "drifting"}


def taxel(row, column):
    """Place in anatomical order: 80 of the fingertips, then the palm of 16 columns."""
    return 80 + 16 * row + column


def raw_cell(side, row, column):
    """Place in the scan of 18 x 20 (docs/streams.md): palm in rows 4 to 18, left one mirrored.

    The scan's palm rows hold the 240 palm taxels one after the other.
    """
    scan_row, scan_column = divmod(taxel(row, column), 20)
    return 20 * scan_row + (19 - scan_column if side == "left" else scan_column)


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("drift_counts", [120, 300])
def test_planted_taxels_are_marked_and_no_others(tmp_path, side, drift_counts):
    planted = {
        f"{state}_taxels": tuple(raw_cell(side, *place) for place in places)
        for state, places in PLANTED.items()
    }
    faults = DeviceFaults(**planted, drift_counts=drift_counts)
    streams = [s for s in pattern_streams() if s.descriptor.name.startswith("tactile_")]
    script = FaultScript(devices={f"glove_{side}": faults})
    with MockStation(streams, script, 1, VirtualClock(10**9), spool_root=tmp_path) as mock:
        for _ in range(NUM_ROUNDS):
            mock.run_take(PROMPT)
        mock.station.health.evaluate()
        found = {s.stream: s.taxels for s in mock.station.health.report().streams}
    expected = {
        STATES.get(state, state): sorted(taxel(*place) for place in places)
        for state, places in PLANTED.items()
    }
    marked = {state: sorted(taxels) for state, taxels in found[f"tactile_{side}"].items()}
    right = sum(len(set(marked.get(state, ())) & set(taxels)) for state, taxels in expected.items())
    false = sum(len(taxels) for taxels in marked.values()) - right
    assert marked == expected, f"{right} right, {8 - right} missed, {false} false"
    other = "right" if side == "left" else "left"
    assert found[f"tactile_{other}"] == {}
