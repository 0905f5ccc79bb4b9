"""Features of object poses against hand calculations, and objects that are absent."""

import numpy as np
import pytest

from dextouch.errors import ShapeError
from services.evaluation.endings import NUM_OBJECT_FEATURES, known_objects, object_features

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
# A quarter turn about x lays a standing object down: its z axis points along −y.
LYING = (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)


def _poses(*objects: tuple[float, ...]) -> np.ndarray:
    return np.repeat(np.array(objects, dtype=np.float64)[None], 3, axis=0)


def test_one_object_by_hand():
    found = object_features(_poses((0.1, -0.2, 0.03, *LYING)))
    assert found.shape == (NUM_OBJECT_FEATURES,) == (105,)
    assert found[:5] == pytest.approx([1, np.arcsinh(3.0), 1.0, -2.0, 0.3])
    assert found[5:14].reshape(3, 3)[:, 2] == pytest.approx([0, -1, 0], abs=1e-6)
    assert found[14:17] == pytest.approx([0, 0, 0], abs=1e-6)
    assert not found[17:].any()


def test_a_pair_by_hand():
    # The second lies 20 mm above and 10 mm along world y of the first, which is turned by 90°
    # about z: seen from it, world y is its x.
    turned = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    found = object_features(_poses((0, 0, 0, *turned), (0, 0.01, 0.02, *UPRIGHT)))
    pair = found[51:69]
    assert pair[:4] == pytest.approx([1, 0.1, 0, 0.2], abs=1e-6)
    assert pair[4:7] == pytest.approx(np.arcsinh([1, 0, 2]), abs=1e-6)
    assert pair[7:16].reshape(3, 3) == pytest.approx(
        np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]), abs=1e-6
    )
    assert pair[16:] == pytest.approx(np.arcsinh([1, 2]))
    assert not found[69:].any()


def test_motion_over_the_three_steps():
    poses = _poses((0, 0, 0, *UPRIGHT))
    poses[0, 0, 2], poses[0, 0, 3:] = 0.002, LYING
    assert object_features(poses)[14:17] == pytest.approx(
        np.arcsinh([1, -1, np.pi / 2 / 0.05]), abs=1e-5
    )


def test_unknown_objects_are_absent():
    poses = _poses((0, 0, 0, *UPRIGHT), (0, 0.1, 0, *UPRIGHT), (0, 0, 0.2, *UPRIGHT))
    poses[1, 1] = np.nan
    assert known_objects(poses).tolist() == [True, False, True]
    found = object_features(poses)
    assert found[[0, 17, 34]].tolist() == [1, 0, 1]
    # Pairs: first with second, first with third, second with third.
    assert found[[51, 69, 87]].tolist() == [0, 1, 0]
    poses[2, 0, 3:] = 0
    assert object_features(poses)[0] == 0


@pytest.mark.parametrize("shape", [(3, 4, 7), (3, 0, 7), (3, 7), (3, 2, 6)])
def test_other_shapes_are_refused(shape):
    with pytest.raises(ShapeError, match="object poses"):
        object_features(np.zeros(shape))
