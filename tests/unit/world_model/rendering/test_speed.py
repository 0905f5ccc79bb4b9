"""What makes drawing faster changes nothing: the network as it is written down, and the start."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn import functional

from services.world_model.checkpoints import read_state_checkpoint
from services.world_model.network.configuration import RendererConfig
from services.world_model.rendering.inputs import PreparedScenes
from services.world_model.rendering.renderer import Renderer, RendererNetwork
from services.world_model.shipped_checkpoints import PRETRAINED
from tests.unit.world_model.rendering.scene_by_hand import (
    BOXES_M,
    K,
    draw,
    drawing,
    shifted,
    turned,
)


class PlainNetwork(RendererNetwork):
    """The same layers by the plain formula: no operation is merged, moved or done in place."""

    def forward(self, inputs):
        def block(layers, x):
            return x + layers.second(functional.relu(layers.first(functional.relu(x))))

        x = torch.cat([functional.pixel_unshuffle(inputs.fine, 2), inputs.coarse], dim=1)
        x = self.stem(x.to(self.stem.weight.dtype))
        passed = []
        for level, blocks in enumerate(self.encoder):
            for layers in blocks:
                x = block(layers, x)
            if level < len(self.down):
                passed.append(x)
                x = self.down[level](x)
        for level in reversed(range(len(self.down))):
            x = functional.interpolate(self.up[level](x), scale_factor=2.0, mode="nearest")
            x = block(self.decoder[level], x + passed[level])
        told = functional.pixel_shuffle(self.head(functional.relu(x)).float(), 2)
        warped, objects, hands = inputs.fine[:, :9].split(3, dim=1)
        weights = told[:, :3].softmax(dim=1)
        mixed = weights[:, 1:2] * inputs.fine[:, 11:12] * (objects - warped)
        mixed = mixed + weights[:, 2:] * inputs.fine[:, 9:11].amax(1, keepdim=True) * (
            hands - warped
        )
        return warped + inputs.change * (mixed + torch.tanh(told[:, 3:]))


def weights_of(config):
    network = RendererNetwork(config)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for weight in network.parameters():
            weight.normal_(std=0.08, generator=generator)
    return network


def trained():
    return read_state_checkpoint(PRETRAINED / "state.safetensors").renderer


def moved_states(still):
    """A swaying camera, and bodies that move."""
    return [
        turned(
            shifted(still, camera_m=(0.002 * i, -0.001 * i, 0.0), objects_m=(0.01 * i, 0.0, 0.0)),
            (0.004 * i, 0.0, 0.01 * i),
        )
        if i
        else still
        for i in range(16)
    ]


@pytest.mark.long
@pytest.mark.parametrize("uses_bfloat16", [False, True])
@pytest.mark.parametrize("which", ["trained", "wide stem"])
def test_images_are_those_of_the_plain_formula(image, still, which, uses_bfloat16):
    torch.set_num_threads(1)
    shape = RendererConfig(widths=(8, 16), depths=(1, 2), stem_px=3)
    network = trained() if which == "trained" else weights_of(shape)
    plain = PlainNetwork(network.config)
    plain.load_state_dict(network.state_dict())
    # Like a photograph: neighbours resemble each other.
    rows = np.linspace(0, 255, 64)
    smooth = (0.5 * rows[:, None, None] + 0.4 * rows[:, None] + 0.1 * image).astype(np.uint8)
    drawn, expected, exact = (
        draw(
            Renderer(one, uses_bfloat16=half), smooth, K, still, moved_states(still), BOXES_M
        ).astype(int)
        for one, half in ((network, uses_bfloat16), (plain, uses_bfloat16), (plain, False))
    )
    assert (expected[1:] != smooth).any(axis=(1, 2, 3)).all()
    off = np.abs(drawn - expected)
    if uses_bfloat16:
        # Rounded elsewhere, but no less exact.
        assert (off > 1).mean() < 1e-3
        assert np.abs(drawn - exact).mean() <= 1.1 * np.abs(expected - exact).mean()
    else:
        assert off.max() <= 1
        assert (off > 0).mean() < 1e-3


@pytest.mark.long
def test_a_start_that_is_remembered_draws_the_same_bits(small, image, still):
    remembering = Renderer(weights_of(small))
    states = moved_states(still)
    other = shifted(still, objects_m=(0.0, 0.02, 0.0))
    brighter = image // 2 + 100
    for start_image, start in ((image, still), (image, still), (brighter, still), (image, other)):
        expected = draw(Renderer(weights_of(small)), start_image, K, start, states, BOXES_M)
        assert (draw(remembering, start_image, K, start, states, BOXES_M) == expected).all()
    # Arrays of the caller that change afterwards are another start.
    changing = image.copy()
    draw(remembering, changing, K, still, states, BOXES_M)
    changing[:] = 7
    expected = draw(Renderer(weights_of(small)), changing, K, still, states, BOXES_M)
    assert (draw(remembering, changing, K, still, states, BOXES_M) == expected).all()


def one_slot(state):
    """The same scene without its second object."""
    return replace(
        state, object_poses=state.object_poses[:1], object_present=state.object_present[:1]
    )


def drawings_of(image, still):
    """Rollouts from other starts, of other lengths (one fills a block), with one object or two."""
    dark, lens = image // 3, K * [[1.1], [1.1], [1.0]]
    states = moved_states(still)
    few = [one_slot(state) for state in states[4:9]]
    return [
        drawing(image, K, still, states[1:], BOXES_M),
        drawing(dark, lens, one_slot(still), few, BOXES_M[:1]),
        drawing(image, K, states[2], states[5:6], BOXES_M),
        drawing(dark, K, still, states * 3, BOXES_M),
        drawing(image, K, still, states[3:4], BOXES_M),
    ]


@pytest.mark.long
@pytest.mark.parametrize("uses_bfloat16", [False, True])
def test_rollouts_drawn_together_are_drawn_as_one_at_a_time(small, image, still, uses_bfloat16):
    torch.set_num_threads(1)
    renderer = Renderer(weights_of(small), uses_bfloat16=uses_bfloat16)
    drawings = drawings_of(image, still)
    together = renderer.draw_all(drawings)
    assert [len(images) for images in together] == [15, 5, 1, 48, 1]
    for one, images in zip(drawings, together, strict=True):
        (alone,) = renderer.draw_all([one])
        assert np.abs(images.astype(int) - alone.astype(int)).max() <= 1
    assert renderer.draw_all([]) == []


@pytest.mark.long
def test_starts_of_several_rollouts_are_remembered_up_to_a_limit(small, image, still, monkeypatch):
    prepared = []
    original = PreparedScenes.of
    monkeypatch.setattr(PreparedScenes, "of", lambda scenes: prepared.append(1) or original(scenes))
    renderer = Renderer(weights_of(small))

    def draw_level(level):
        draw(renderer, np.full_like(image, level), K, still, [still], BOXES_M)

    for level in [*range(64), *range(64)]:
        draw_level(level)
    assert len(prepared) == 64
    for level in (0, 200, 0):
        draw_level(level)
    assert len(prepared) == 65
    # The start that was not used for longest has been dropped.
    draw_level(1)
    assert len(prepared) == 66
    assert len(renderer._starts._values) == 64
