"""What the joint network promises whatever its weights are."""

from dataclasses import replace

import pytest
import torch

from services.world_model.network.attention import clean_mask
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import JointLatents, JointWorldModel, stack_noise
from services.world_model.training.joint_dataset import WindowPosition


def _generator(seed):
    return torch.Generator().manual_seed(seed)


@pytest.fixture
def model(tiny_config):
    """Random everywhere: zero-initialized outputs would make every test true."""
    torch.manual_seed(1)
    model = JointWorldModel(tiny_config).eval().requires_grad_(requires_grad=False)
    for parameter in model.parameters():
        parameter.add_(0.1 * torch.randn(parameter.shape))
    return model


@pytest.fixture
def inputs(toy_episodes, tiny_config):
    requests = [
        e.cut(WindowPosition(0, 2, 17, action_kind="commanded")).request for e in toy_episodes[:3]
    ]
    return build_inputs(requests, tiny_config)


@pytest.fixture
def noisy(model):
    return stack_noise([model.noise(17, _generator(seed)) for seed in range(3)])


def test_the_shipped_size_fits_its_budget():
    model = JointWorldModel(NetworkConfig())
    count = sum(p.numel() for p in model.parameters())
    stored = sum(p.numel() for p in (*model.parameters(), *model.buffers())) * 4
    assert 0.75e6 < count < 1.5e6
    assert stored < 5e6


@pytest.mark.parametrize("num_steps", [5, 9, 13, 17])
def test_every_query_sees_a_key_and_clean_ones_see_only_clean_ones(model, num_steps):
    mask = model.attention_mask(num_steps)
    assert mask.any(dim=1).all()
    assert mask.diagonal().all()
    per_latent = model.config.tokens_per_latent
    first_touch = (1 + (num_steps - 1) // 4) * per_latent
    clean = torch.zeros(len(mask), dtype=torch.bool)
    clean[:per_latent] = True
    clean[first_touch : first_touch + 2] = True
    assert not mask[clean][:, ~clean].any()
    assert mask[~clean].all()


def test_a_mask_without_clean_tokens_hides_nothing():
    assert clean_mask(torch.zeros(5, dtype=torch.bool)).all()


def test_noise_never_reaches_clean_tokens(model, inputs, noisy):
    first = model.first_latents(inputs)
    other = JointLatents(noisy.video.flip(0), noisy.tactile.flip(0))
    t = torch.full((3,), 0.7)
    a, b = model(inputs, first, noisy, t), model(inputs, first, other, t)
    torch.testing.assert_close(a.video[:, 0], b.video[:, 0], rtol=0, atol=1e-6)
    torch.testing.assert_close(a.tactile[:, 0], b.tactile[:, 0], rtol=0, atol=1e-6)
    assert (a.video[:, 1:] - b.video[:, 1:]).abs().max() > 1e-3


def test_clean_tokens_do_not_depend_on_the_time_of_the_noisy_ones(model, inputs, noisy):
    first = model.first_latents(inputs)
    early = model(inputs, first, noisy, torch.full((3,), 0.1))
    late = model(inputs, first, noisy, torch.full((3,), 0.9))
    torch.testing.assert_close(early.video[:, 0], late.video[:, 0], rtol=0, atol=1e-6)
    torch.testing.assert_close(early.tactile[:, 0], late.tactile[:, 0], rtol=0, atol=1e-6)
    assert (early.video[:, 1:] - late.video[:, 1:]).abs().max() > 1e-3


def test_each_stream_hears_the_other(model, inputs, noisy):
    first = model.first_latents(inputs)
    t = torch.full((3,), 0.7)
    a = model(inputs, first, noisy, t)
    b = model(inputs, first, JointLatents(noisy.video, noisy.tactile.flip(0)), t)
    c = model(inputs, first, JointLatents(noisy.video.flip(0), noisy.tactile), t)
    assert (a.video - b.video)[:, 1:].abs().max() > 1e-4
    assert (a.tactile - c.tactile)[:, 1:].abs().max() > 1e-4


@pytest.mark.parametrize("t", [0.0, 1e-6, 1e-3, 0.5, 1.0])
def test_every_time_gives_finite_guesses_and_gradients(tiny_config, inputs, noisy, t):
    torch.manual_seed(0)
    model = JointWorldModel(tiny_config)
    guess = model(inputs, model.first_latents(inputs), noisy, torch.full((3,), t))
    torch.autograd.backward(guess.video.square().sum() + guess.tactile.square().sum())
    assert torch.isfinite(guess.video).all()
    assert torch.isfinite(guess.tactile).all()
    assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None)


@pytest.mark.parametrize("pressure_kpa", [0.0, 1e5])
def test_silent_and_saturated_touch_give_finite_futures(model, inputs, noisy, pressure_kpa):
    touched = replace(inputs, first_tactile_kpa=torch.full((3, 2, 320), pressure_kpa))
    future = model.predict(touched, noisy)
    assert torch.isfinite(future.tactile_kpa).all()
    assert (future.tactile_kpa >= 0).all()
    assert torch.isfinite(future.images).all()


def condition_of(side, inputs, features, times):
    return side.at(side.constants(inputs, features), times)


@pytest.mark.parametrize("part", ["hands", "camera"])
def test_each_step_conditions_its_own_latent_and_its_own_touch(model, inputs, part):
    # Equation 4 of the paper: video latent j sees a[4j-3 … 4j], touch at step t sees a_t, index 0
    # sees no action. Step s therefore moves latent ceil(s / 4), touch s, and nothing else.
    times_video, times_tactile = torch.full((3, 5), 0.5), torch.full((3, 17), 0.5)
    before = model.normalizer(inputs)
    video = condition_of(model.video_condition, inputs, before, times_video).vector
    tactile = condition_of(model.tactile_condition, inputs, before, times_tactile).vector
    for step in range(17):
        changed = getattr(inputs, part).clone()
        changed[:, step] += 0.3
        after = model.normalizer(replace(inputs, **{part: changed}))
        changed_video = condition_of(model.video_condition, inputs, after, times_video).vector
        changed_tactile = condition_of(model.tactile_condition, inputs, after, times_tactile).vector
        moved_video, moved_tactile = (
            (changed_video - video).abs(),
            (changed_tactile - tactile).abs(),
        )
        latents = [] if step == 0 else [-(-step // 4)]
        assert moved_video.amax((0, 2)).gt(1e-4).nonzero().flatten().tolist() == latents
        steps = [] if step == 0 else [step]
        assert moved_tactile.amax((0, 2, 3)).gt(1e-4).nonzero().flatten().tolist() == steps


def test_the_condition_of_index_zero_holds_no_action_term(model, inputs):
    # c_0 = 0: whatever the action layers put out, index 0 is time, words and scene alone.
    features = model.normalizer(inputs)
    for condition, steps in ((model.video_condition, 5), (model.tactile_condition, 17)):
        t = torch.full((3, steps), 0.5)
        before = condition_of(condition, inputs, features, t).vector
        condition.actions[-1].bias += 1.0
        after = condition_of(condition, inputs, features, t).vector
        change = (after - before).flatten(2).abs().amax((0, 2))
        assert change[0] == 0.0
        assert change[1:].min() > 0.5


def test_words_kind_and_layout_matter(model, inputs, noisy):
    base = model.predict(inputs, noisy).tactile_kpa
    changes = {
        "words": inputs.words.flip(1) * 0 + 7,
        "commanded": 1 - inputs.commanded,
        "layout": inputs.layout + 0.1,
        "raster": inputs.raster.flip(1),
        "first_image": inputs.first_image.flip(1),
    }
    for name, tensor in changes.items():
        changed = model.predict(replace(inputs, **{name: tensor}), noisy).tactile_kpa
        assert (changed - base).abs().max() > 1e-5, name


@pytest.mark.long
@pytest.mark.parametrize("num_steps", [5, 9, 13, 17])
def test_a_batch_of_one_equals_a_batch_of_many(model, toy_episodes, num_steps):
    requests = [e.cut(WindowPosition(0, 4, num_steps)).request for e in toy_episodes]
    noises = [model.noise(num_steps, _generator(seed)) for seed in range(len(requests))]
    together = model.predict(build_inputs(requests, model.config), stack_noise(noises))
    for index, (request, noise) in enumerate(zip(requests, noises, strict=True)):
        alone = model.predict(build_inputs([request], model.config), noise)
        torch.testing.assert_close(alone.images[0], together.images[index], rtol=0, atol=1e-5)
        torch.testing.assert_close(
            alone.tactile_kpa[0], together.tactile_kpa[index], rtol=1e-5, atol=1e-5
        )
    assert together.images.shape[1] == num_steps - 1


def test_the_seed_decides_the_noise(model):
    a, b, c = (model.noise(9, _generator(seed)) for seed in (5, 5, 6))
    assert torch.equal(a.video, b.video)
    assert torch.equal(a.tactile, b.tactile)
    assert not torch.equal(a.tactile, c.tactile)


def test_true_residuals_decode_to_the_truth(tiny_config, toy_episodes):
    torch.manual_seed(0)
    full = tiny_config.model_copy(update={"codec_channels": 768, "palm_channels": 240})
    model = JointWorldModel(full)
    windows = [episode.cut(WindowPosition(0, 0, 9)) for episode in toy_episodes]
    images = torch.stack([torch.from_numpy(w.images) for w in windows])
    touch = torch.stack([torch.from_numpy(w.tactile_kpa) for w in windows])
    model.codec.fit(images)
    model.tokenizer.fit(touch.flatten(0, 1))
    inputs = build_inputs([w.request for w in windows], full)
    future = model.decode(model.first_latents(inputs), model.targets(images, touch))
    torch.testing.assert_close(future.tactile_kpa, touch[:, 1:], rtol=1e-2, atol=1e-2)
    assert (future.images - images[:, 1:] / 255).abs().max() < 0.01
