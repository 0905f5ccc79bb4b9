"""Forces of pads are pressure times area of the taxels in contact."""

import numpy as np
import pytest

from dextouch.errors import NonFiniteError, ShapeError
from dextouch.tactile import DEXTOUCH_V1


def test_pressure_times_area_by_pad():
    tactile = np.zeros((2, 320), dtype=np.float32)
    tactile[0, 16:32] = 10.0
    tactile[1, 80:] = 5.0
    forces = DEXTOUCH_V1.pad_forces_n(tactile)
    assert forces.shape == (2, 6)
    # 16 taxels of 16 mm² at 10 kPa, 240 of 30 mm² at 5 kPa.
    np.testing.assert_allclose(forces[0], [0, 2.56, 0, 0, 0, 0])
    np.testing.assert_allclose(forces[1], [0, 0, 0, 0, 0, 36.0])


def test_noise_below_contact_is_no_force():
    assert (DEXTOUCH_V1.pad_forces_n(np.full((1, 320), 1.9)) == 0).all()


def test_what_is_no_touch_is_refused():
    with pytest.raises(ShapeError, match="expected"):
        DEXTOUCH_V1.pad_forces_n(np.zeros((3, 360)))
    with pytest.raises(NonFiniteError):
        DEXTOUCH_V1.pad_forces_n(np.full((1, 320), np.nan))
