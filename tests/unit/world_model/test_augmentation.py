"""Images as other cameras take them: the truth stays where the intrinsics say."""

import numpy as np
import pytest
import torch

from services.world_model.dynamics.start_reader import FirstStep, StartReader
from services.world_model.training.member_training import as_another_camera
from tests.unit.world_model.test_dynamics import CONFIG, NUM_POINTS

PX = 64


def steps(image, count):
    return FirstStep(
        image.expand(count, PX, PX, 3),
        torch.tensor([[60.0, 0, 32], [0, 60, 32], [0, 0, 1]]).expand(count, 3, 3),
        torch.eye(4).expand(count, 4, 4),
        torch.zeros(count, 2, NUM_POINTS, 3),
        torch.zeros(count, 12),
        torch.zeros(count, dtype=torch.int64),
    )


def with_a_spot(column, row):
    """A bright blob about a place in pixels, the first pixel's middle at 0.5."""
    rows, columns = np.mgrid[0:PX, 0:PX] + 0.5
    blob = np.exp(-((columns - column) ** 2 + (rows - row) ** 2) / 18)
    return torch.tensor((60 + 150 * blob[..., None]).repeat(3, axis=2).astype(np.uint8))


def middles(images):
    """Weighted middles of the brightest part of each image, x and y in pixels."""
    grey = images.mean(1)
    weight = (grey - grey.flatten(1).quantile(0.9, dim=1)[:, None, None]).clamp_min(0.0)
    places = torch.arange(PX) + 0.5
    total = weight.sum((1, 2))
    x = (weight.sum(1) * places).sum(1) / total
    return torch.stack([x, (weight.sum(2) * places).sum(1) / total], dim=1)


def test_a_spot_moves_as_the_intrinsics_say():
    first = steps(with_a_spot(30.0, 36.0), 400)
    images, changed = as_another_camera(first, torch.Generator().manual_seed(0))
    moved = changed.K_head[:, :2, 2] - first.K_head[:, :2, 2]
    assert moved.abs().max() > 1.2
    off = middles(images) - torch.tensor([30.0, 36.0]) - moved
    # What the intrinsics do not know: 0.15 px, and what noise does to a middle.
    assert off.std() < 0.3
    assert off.mean(0).abs().max() < 0.05
    # The images as they are have the intrinsics as they were.
    same = (images == first.image.permute(0, 3, 1, 2) / 255).flatten(1).all(1)
    assert 0.08 < same.float().mean() < 0.25
    assert (moved[same] == 0).all()


@pytest.mark.long
def test_light_colour_noise_and_sharpness_vary_within_bounds():
    first = steps(with_a_spot(32.0, 32.0), 400)
    images, _ = as_another_camera(first, torch.Generator().manual_seed(1))
    assert 0 <= images.min() <= images.max() <= 1
    brightness = images.mean((1, 2, 3)) / (first.image.float().mean() / 255)
    assert brightness.quantile(0.05) < 0.85
    assert brightness.quantile(0.95) > 1.15
    warmth = images[:, 0].mean((1, 2)) / images[:, 2].mean((1, 2))
    assert warmth.quantile(0.05) < 0.9
    assert warmth.quantile(0.95) > 1.1
    again, _ = as_another_camera(first, torch.Generator().manual_seed(1))
    assert torch.equal(images, again)


def test_exposure_and_the_colour_of_light_do_not_move_what_is_read():
    torch.manual_seed(0)
    reader = StartReader(CONFIG.model_copy(update={"image_px": PX})).eval()
    first = steps(with_a_spot(30.0, 36.0), 1)
    image = first.image.permute(0, 3, 1, 2).float() / 255
    warm = image * torch.tensor([1.1, 1.0, 0.85])[:, None, None] * 0.9
    with torch.no_grad():
        plain, other, unlike = (
            reader.read(each, first)[-1] for each in (image, warm, image.flip(-1))
        )
    off_m = (plain.objects.position_m - other.objects.position_m)[0, 0].norm()
    assert off_m < 0.2 * (plain.objects.position_m - unlike.objects.position_m)[0, 0].norm()
