"""Options of the joint model: conditioning, targets, predictions, losses, instructions."""

import itertools
import re

import numpy as np
import pytest
import torch

from dextouch.errors import InvalidInputError
from services.twin.names import TASK_NAMES
from services.twin.tasks import get_task
from services.world_model.checkpoints import CheckpointMetadata, write_checkpoint
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.flow_matching import sample
from services.world_model.network.inputs import build_inputs
from services.world_model.network.instruction import NO_WORD, instruction_ids
from services.world_model.network.model import JointLatents, JointWorldModel, Sampling, stack_noise
from services.world_model.training.joint_dataset import WindowSampler
from services.world_model.training.joint_objective import LossOptions, contact_or_changing
from services.world_model.world import open_world
from tests.unit.world_model.conftest import losses

CROSS = {"action_conditioning": "cross_attention", "add_condition_to_tokens": False}
OPTIONS = [
    {},
    CROSS,
    {"prediction": "velocity"},
    {"video_target": "plain", "tactile_target": "plain"},
    {"use_scene_encoder": False, "use_pose_raster": False},
    {"use_touch": False, **CROSS},
    {"instruction_encoder": "subwords"},
    {"tokenizer": "split_hands", "tactile_tokens": "pad", "tactile_channels": 48, **CROSS},
]


def model_with(tiny_config, **options):
    torch.manual_seed(0)
    model = JointWorldModel(tiny_config.model_copy(update=options)).eval()
    # Heads start at zero; without this nothing would depend on anything.
    with torch.no_grad():
        for weight in model.parameters():
            if weight.abs().max() == 0:
                weight.normal_(0.0, 0.1)
    return model


@pytest.fixture
def batch(toy_episodes):
    return WindowSampler(toy_episodes, np.random.default_rng(0), max_steps=17).draw(2, 17)


@pytest.mark.long
@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_every_option_learns_and_predicts(tiny_config, batch, options):
    model = model_with(tiny_config, **options)
    inputs = build_inputs(batch.requests, model.config)
    loss = losses(model, batch, generator=torch.Generator().manual_seed(0))
    (loss.video + loss.tactile).backward()
    unused = {name for name, weight in model.named_parameters() if weight.requires_grad}
    unused -= {name for name, weight in model.named_parameters() if weight.grad is not None}
    if not model.config.use_pose_raster:
        unused -= {"video.embed_raster.weight"}
    assert unused == set()
    noise = stack_noise([model.noise(17, torch.Generator().manual_seed(i)) for i in range(2)])
    future = model.predict(inputs, noise)
    assert torch.isfinite(future.images).all()
    assert future.tactile_kpa.shape == (2, 16, 2, 320)
    assert bool(future.tactile_kpa.any()) == model.config.use_touch


@pytest.mark.long
@pytest.mark.parametrize("conditioning", ["adaln", "cross_attention"])
def test_each_latent_depends_on_its_own_actions_first(tiny_config, batch, conditioning):
    """With attention off, latent j is a function of actions 4j-3 … 4j, and step t of action t."""
    model = model_with(
        tiny_config,
        action_conditioning=conditioning,
        use_pose_raster=False,
        use_scene_encoder=False,
    )
    for layer in model.layers:
        for block in (layer.video, layer.tactile):
            torch.nn.init.zeros_(block.to_out.weight)
    inputs = build_inputs(batch.requests, model.config)
    first = model.first_latents(inputs)
    noise = stack_noise([model.noise(17, torch.Generator().manual_seed(i)) for i in range(2)])
    t = torch.full((2,), 0.7)
    inputs.hands.requires_grad_()
    found = model(inputs, first, noise, t)
    for latent, step in itertools.product(range(1, 5), range(1, 17)):
        (gradient,) = torch.autograd.grad(
            found.video[:, latent].sum(), inputs.hands, retain_graph=True
        )
        assert bool(gradient[:, step].any()) == (4 * latent - 3 <= step <= 4 * latent)
    for at, step in itertools.product((1, 7, 16), range(17)):
        (gradient,) = torch.autograd.grad(
            found.tactile[:, at].sum(), inputs.hands, retain_graph=True
        )
        assert bool(gradient[:, step].any()) == (at == step)


def test_the_first_tokens_take_nothing_from_actions(tiny_config, batch):
    model = model_with(tiny_config, **CROSS)
    inputs = build_inputs(batch.requests, model.config)
    parts = model.video_condition.constants(inputs, model.normalizer(inputs))
    condition = model.video_condition.at(parts, torch.full((2, 5), 0.5))
    actions = condition.actions
    tokens = torch.randn(2, 5 * model.config.tokens_per_latent, 32)
    taken = model.layers[0].video.action_attention(tokens, actions)
    first = model.config.tokens_per_latent
    assert not taken[:, :first].any()
    assert taken[:, first:].any()


@pytest.mark.parametrize("num_steps", [1, 3, 8])
def test_velocities_are_integrated_as_by_plain_euler_steps(num_steps):
    """x' = x + (t' - t) v in float64, against the sampler, which steps by predicted x_0."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(3, 4, generator=generator)
    slope = torch.randn(4, 4, generator=generator)

    def velocity(x, t):
        return torch.tanh(x.float() @ slope) * (1.0 + t)

    x = noise.double()
    times = [3.0 * u / (1.0 + 2.0 * u) for u in np.linspace(1.0, 0.0, num_steps + 1)]
    for t, following in itertools.pairwise(times):
        x = x + (following - t) * velocity(x, t).double()

    def denoise(video, tactile, t):
        clean = video - t[:, None] * velocity(video, t[0].item())
        return clean, tactile

    found, _ = sample(denoise, (noise, noise), num_steps=num_steps, shift=3.0)
    torch.testing.assert_close(found.double(), x, atol=2e-5, rtol=1e-5)


def test_a_perfect_velocity_gives_the_recorded_window(tiny_config, batch):
    """The network that returns ε - x_0 of the truth must have no loss and sample the truth."""
    model = model_with(tiny_config, prediction="velocity", video_target="plain")
    inputs = build_inputs(batch.requests, model.config)
    clean = model.targets(batch.images, batch.tactile_kpa)
    noise = stack_noise([model.noise(17, torch.Generator().manual_seed(i)) for i in range(2)])
    model.denoise = lambda *_: JointLatents(
        noise.video - clean.video, noise.tactile - clean.tactile
    )
    future = model.predict(inputs, noise, sampling=Sampling(4))
    expected = model.decode(model.first_latents(inputs), clean)
    torch.testing.assert_close(future.images, expected.images, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(future.tactile_kpa, expected.tactile_kpa, atol=1e-3, rtol=1e-3)


def test_plain_latents_decode_to_what_was_encoded(tiny_config, batch):
    plain = model_with(tiny_config, video_target="plain", tactile_target="plain")
    anchored = model_with(tiny_config)
    first = plain.first_latents(build_inputs(batch.requests, plain.config))
    futures = [
        model.decode(first, model.targets(batch.images, batch.tactile_kpa))
        for model in (plain, anchored)
    ]
    torch.testing.assert_close(futures[0].images, futures[1].images)
    torch.testing.assert_close(futures[0].tactile_kpa, futures[1].tactile_kpa)


def test_tokens_in_contact_or_changing_by_a_plain_loop():
    kpa = torch.rand(2, 6, 2, 320, generator=torch.Generator().manual_seed(0)) ** 12 * 3.0
    kpa[:, 3] = kpa[:, 2]
    pads = [range(16 * i, 16 * i + 16) for i in range(5)] + [range(80, 320)]
    for num_tokens, groups in ((6, pads), (1, [range(320)])):
        found = contact_or_changing(kpa, num_tokens)
        for b, t, hand, token in itertools.product(range(2), range(6), range(2), range(num_tokens)):
            expected = False
            for taxel in groups[token]:
                here = kpa[b, t, hand, taxel]
                before = kpa[b, max(t - 1, 0), hand, taxel]
                expected |= bool(here >= 2.0 or kpa[b, 0, hand, taxel] >= 2.0)
                expected |= bool(abs(here - before) >= 0.5)
            assert found[b, t, hand, token] == expected
    assert 0.1 < contact_or_changing(kpa, 6).float().mean() < 0.9


def test_idle_tokens_do_not_count_in_the_papers_loss(tiny_config, batch):
    model = model_with(tiny_config)
    clean = model.targets(batch.images, batch.tactile_kpa)
    counted = contact_or_changing(batch.tactile_kpa, 1)[:, 1:]
    assert counted.any()
    assert not counted.all()
    wrong = torch.zeros_like(clean.tactile)
    wrong[:, 1:][~counted] = 9.0
    model.forward = lambda *_: JointLatents(clean.video, clean.tactile + wrong)
    for touch_loss, is_zero in (("contact_or_changing", True), ("all", False)):
        generator = torch.Generator().manual_seed(0)
        loss = losses(model, batch, generator=generator, options=LossOptions(touch_loss=touch_loss))
        assert (loss.tactile == 0) == is_zero


def test_no_two_instructions_of_the_twin_share_their_subwords():
    config = NetworkConfig(instruction_encoder="subwords")
    sentences = [get_task(name).instruction for name in TASK_NAMES]
    known = {tuple(sorted(set(instruction_ids(one, config).tolist()))) for one in sentences}
    assert len(known) == len(set(sentences))
    words = {word for one in sentences for word in re.findall("[a-z]+", one.lower())}
    assert len({tuple(instruction_ids(word, config).tolist()) for word in words}) == len(words)
    assert instruction_ids("", config).eq(NO_WORD).all()


def test_a_model_without_touch_is_only_opened_on_request(tiny_config, tmp_path):
    model = model_with(tiny_config, use_touch=False)
    metadata = CheckpointMetadata(
        name="video", network=model.config, tasks=("stand_bottle",), command="", seed=0,
        training_steps=0, training_cpu_s=0.0, train_episode_ids=(), train_fingerprints=(),
        data_hash="",
    )  # fmt: skip
    path = tmp_path / "video.safetensors"
    write_checkpoint(path, model, metadata)
    with pytest.raises(InvalidInputError, match="predicts images alone"):
        open_world(path)
    assert not open_world(path, needs_touch=False).description.predicts_touch
