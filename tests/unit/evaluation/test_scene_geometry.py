"""Bodies of predicted images by their colours, on images painted by hand."""

import numpy as np
import pytest

from services.evaluation.prediction_scenes import (
    FAR_M,
    SceneGeometry,
    centroids,
    depth_errors,
    implied_depth,
    labelled,
    trajectory_accuracies,
)

# Background, table, and two bodies, the second one in two colours.
COLOURS = np.array(
    [
        [0, 0.16, 0.17, 0.20],
        [1, 0.60, 0.50, 0.40],
        [2, 0.10, 0.60, 0.20],
        [3, 0.90, 0.20, 0.20],
        [3, 0.95, 0.92, 0.30],
    ]
)
PX = 20


def painted(labels, *, brightness=0.6):
    """An image of these labels, each in the first of its colours."""
    rgb = np.array([COLOURS[COLOURS[:, 0] == label][0, 1:] for label in labels.ravel()])
    shade = np.where(labels.ravel() == 0, 1.0, brightness)[:, None]
    return (255 * rgb * shade).round().astype(np.uint8).reshape(*labels.shape, 3)


def scene(columns):
    """A body of 4 by 4 px that moves along the columns, on a table below a background."""
    labels = np.ones((len(columns), PX, PX), dtype=np.int64)
    labels[:, :3] = 0
    for index, column in enumerate(columns):
        labels[index, 8:12, column : column + 4] = 2
    depth_m = np.where(labels == 2, 0.4, np.where(labels == 1, 0.5, np.inf))
    table_m = np.full(labels.shape, 0.5)
    return SceneGeometry(COLOURS, labels, depth_m, table_m)


@pytest.mark.parametrize("brightness", [0.35, 0.7, 1.0])
def test_pixels_are_labelled_at_any_brightness(brightness):
    labels = np.random.default_rng(0).integers(0, 4, size=(3, PX, PX))
    assert (labelled(painted(labels, brightness=brightness), COLOURS) == labels).all()


def test_centroids_of_bodies_and_of_none():
    labels = scene([2, 7]).labels
    # Rows 8 … 11 and columns 2 … 5.
    np.testing.assert_allclose(centroids(labels, 2), [[3.5, 9.5], [8.5, 9.5]])
    assert np.isnan(centroids(labels, 3)).all()


def test_only_bodies_that_move_have_trajectories():
    geometry = scene([2, 4, 6, 8])
    assert trajectory_accuracies(geometry, painted(geometry.labels)) == [1.0]
    assert trajectory_accuracies(scene([5, 5, 5]), painted(scene([5, 5, 5]).labels)) == []
    # A copy of the first image: the distances 0, 2, 4, 6 over four steps, tolerance 1 px.
    (copied,) = trajectory_accuracies(geometry, painted(geometry.labels)[[0] * 4])
    assert copied == pytest.approx(np.exp(-12 / 4))


def test_a_body_in_the_wrong_place_has_the_depth_error_of_both_places():
    geometry = scene([2])
    right, wrong = painted(geometry.labels), painted(scene([12]).labels)
    depth_m = implied_depth(geometry, right)
    np.testing.assert_allclose(depth_m[geometry.labels == 2], 0.4)
    np.testing.assert_allclose(depth_m[geometry.labels == 0], FAR_M)
    assert depth_errors(geometry, right) == pytest.approx([0.0], abs=1e-12)
    # 16 px say 0.5 of 0.4 m, 16 others 0.4 of 0.5 m, of the 340 px that show something.
    expected = (16 * 0.25 + 16 * 0.2) / (PX * (PX - 3))
    assert depth_errors(geometry, wrong) == pytest.approx([expected])
