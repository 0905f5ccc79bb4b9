"""Taxels that were not measured are filled for training from their nearest neighbours."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from dextouch.tactile import DEXTOUCH_V1
from services.world_model.training.scene_table import _nearest_measured


def test_unmeasured_taxels_are_filled_from_the_nearest_ones_as_scipy_finds_them():
    measured = np.random.default_rng(0).random(320) < 0.2
    nearest = _nearest_measured(measured, DEXTOUCH_V1)
    assert measured[nearest].all()
    for pad in (pad for stack in DEXTOUCH_V1.split(np.arange(320)) for pad in stack):
        rows, columns = np.indices(pad.shape)
        found = np.searchsorted(pad.ravel(), nearest[pad])
        off = np.hypot(found // pad.shape[1] - rows, found % pad.shape[1] - columns)
        np.testing.assert_allclose(off, distance_transform_edt(~measured[pad]))


@pytest.mark.long
def test_training_needs_no_scipy_which_the_extra_model_lacks():
    module = "services.world_model.training.state_trainer"
    code = f"import sys; sys.modules['scipy'] = None; import {module}"
    subprocess.run([sys.executable, "-c", code], check=True)
