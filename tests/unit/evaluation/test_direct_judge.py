"""Direct judge: its geometry by hand, and that it learns what its inputs tell."""

import numpy as np
import pytest
import torch

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.hands.actions import AnchorPoses
from services.evaluation.checkpoints import load_checkpoint, save_checkpoint
from services.evaluation.direct_data import LabelledAttempt, View
from services.evaluation.direct_judge import KIND, DirectJudge
from services.evaluation.direct_network import (
    Attempt,
    Commands,
    DirectShape,
    Objects,
    Views,
    _at_height,
    attempt_tensors,
    command_features,
)
from services.evaluation.direct_training import DirectSettings, train_direct_judge
from services.evaluation.statistics import area_under_roc

SIZE = 16
K_HEAD = np.array([[16.0, 0, 8], [0, 16.0, 8], [0, 0, 1]])
# Half a metre above the table, straight down: pixel x is world x, pixel y is world −y.
T_CAMERA = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.5], [0, 0, 0, 1]])
ANCHOR = AnchorPoses(np.eye(4), np.eye(4), T_CAMERA)
SHAPE = DirectShape(tasks=("reach",), num_objects=(1,), image_size_px=SIZE)


def _attempt(place_m: np.ndarray, goal_m: np.ndarray, *, task: str = "reach") -> Attempt:
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    x, y = 8 + place_m[0] / 0.5 * 16, 8 - place_m[1] / 0.5 * 16
    spot = 220 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 4)
    image = np.repeat(spot[..., None], 3, axis=2).astype(np.uint8)
    actions = np.zeros((80, 67))
    actions[:, [3, 7, 12, 16, 61, 65]] = 1.0
    actions[:, :2] = goal_m * np.linspace(0, 1, 80)[:, None]
    return Attempt(task, image, np.zeros((2, 320), np.float32), actions, ANCHOR, K_HEAD)


def _labelled(seed: int) -> LabelledAttempt:
    rng = np.random.default_rng(seed)
    place_m = rng.uniform(-0.15, 0.15, 2)
    error_m = rng.uniform(-0.06, 0.06, 2)
    attempt = _attempt(place_m, place_m + error_m)
    pose = np.array([[*place_m, 0.0, 1.0, 0, 0, 0]])
    success = bool(np.abs(error_m).max() < 0.04)
    view = View(attempt.image, T_CAMERA, pose)
    return LabelledAttempt(f"reach-{seed}", "Touch it.", f"reach/{seed}", success, attempt, [view])


def test_rays_meet_their_heights_by_hand():
    views = Views(
        torch.zeros((1, 3, SIZE, SIZE), dtype=torch.uint8),
        torch.from_numpy(K_HEAD).float()[None],
        torch.from_numpy(T_CAMERA).float()[None],
        torch.zeros(1, dtype=torch.long),
    )
    # Four pixels right of the centre: a quarter of the distance, which is 0.5 m or 0.3 m.
    pixel = torch.tensor([[[12.0, 8.0], [12.0, 4.0], [8.0, 8.0]]])
    found = _at_height(pixel, torch.tensor([[0.0, 0.2, 0.1]]), views)
    expected = [[0.125, 0.0, 0.0], [0.075, 0.075, 0.2], [0.0, 0.0, 0.1]]
    np.testing.assert_allclose(found[0], expected, atol=1e-6)


def test_commands_are_seen_from_the_object_by_hand():
    points = torch.zeros((1, 20, 2, 2, 6, 3))
    points[..., 0] = 0.31
    zeros = torch.zeros
    commands = Commands(points, zeros((1, 20, 2, 6)), zeros((1, 20, 2, 20)), zeros((1, 24)))
    position = torch.zeros((1, 3, 3))
    position[0, 0, 0] = 0.30
    axes = torch.zeros((1, 3, 2, 3))
    # The object's z axis looks up, its x axis along world y: world x is across, backwards.
    axes[0, 0] = torch.tensor([[0.0, 0, 1], [0, 1.0, 0]])
    used = torch.tensor([[True, False, False]])
    features = command_features(commands, Objects(position, axes), used)
    first = features[0, 0, :18].reshape(3, 6)
    one = np.arcsinh(1.0) / 2
    np.testing.assert_allclose(first[0], [one, 0, 0, 0, 0, -one], atol=1e-5)
    assert not first[1:].any()


def test_fingertips_are_those_of_the_hand():
    attempt = _attempt(np.zeros(2), np.array([0.2, 0.0]))
    _, commands = attempt_tensors([attempt], SHAPE)
    # At the end of the second group, step 8, row 7 of 80: 0.2 · 7 / 79 along x.
    wrist = commands.points_m[0, 1, 1, 0, 0]
    np.testing.assert_allclose(wrist, [0.2 * 7 / 79, 0, 0], atol=1e-6)
    # The right hand stands; its five fingertips are some centimetres away from its wrist.
    right = commands.points_m[0, 1, 1, 1]
    distances = (right[1:] - right[0]).norm(dim=-1)
    assert bool(((distances > 0.05) & (distances < 0.3)).all())


@pytest.mark.slow
def test_a_trained_judge_tells_near_from_far(tmp_path):
    settings = DirectSettings(
        num_finder_steps=120, num_judge_steps=200, learning_rate=4e-3, max_cpu_s=60, batch_size=32
    )
    items = [_labelled(seed) for seed in range(300)]
    checkpoint = train_direct_judge(items, settings, command="test")
    path = tmp_path / "direct.safetensors"
    save_checkpoint(path, checkpoint)
    judge = DirectJudge.load(path)
    assert len(judge.metadata.training_starts) == 300
    tested = [_labelled(seed) for seed in range(1000, 1200)]
    told = judge.probabilities([item.attempt for item in tested])
    assert area_under_roc(told, np.array([item.success for item in tested])) > 0.8
    assert load_checkpoint(path, kind=KIND).metadata.tasks == ("reach",)
    with pytest.raises(UnknownNameError, match="direct judge"):
        judge.log_odds([_attempt(np.zeros(2), np.zeros(2), task="other")])
    with pytest.raises(InvalidInputError, match="no attempts"):
        judge.log_odds([])


def test_episodes_that_all_end_alike_are_refused():
    items = [_labelled(seed) for seed in range(60)]
    failed = [item for item in items if not item.success]
    with pytest.raises(InvalidInputError, match="same outcome"):
        train_direct_judge(failed, DirectSettings(), command="test")
