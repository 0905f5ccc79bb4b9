"""A mock's ledger in its file."""

import json

import pytest

from services.acquisition.mocks.faults import FORMAT, DeviceLedger, Fate, Ledger
from tests.unit.acquisition.ledgers import load


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_a_ledger_of_any_length_is_read_as_it_was_saved(tmp_path, rng, count):
    ledger = Ledger(3, 10**15, {"glove_left": DeviceLedger(5, {"skew_ppm": 50.0})})
    ledger.devices["head"] = DeviceLedger()
    for number in range(count):
        times_ns = tuple(rng.integers(0, 2**62, 3).tolist())
        ledger.devices["glove_left"].note(number, times_ns, Fate.LATE, number % 3)
    ledger.save(tmp_path / "ledger.json")
    assert load(tmp_path / "ledger.json") == ledger
    content = json.loads((tmp_path / "ledger.json").read_text())
    assert content["format"] == FORMAT
    assert content["devices"]["glove_left"]["sequence"] == list(range(count))
    assert content["devices"]["glove_left"]["fate"] == ["late"] * count
