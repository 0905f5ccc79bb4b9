"""The joint model as a whole on other devices and in other precisions."""

import numpy as np
import pytest
import torch

from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import JointWorldModel
from services.world_model.pretrained_video import load_pretrained
from services.world_model.training.joint_dataset import WindowPosition, WindowSampler
from services.world_model.training.joint_objective import LossOptions
from tests.unit.world_model.conftest import losses


@pytest.fixture(params=["tiny", "wan"])
def model(request, tiny_config, full_config, pretrained_folder):
    torch.manual_seed(0)
    model = JointWorldModel(tiny_config if request.param == "tiny" else full_config).eval()
    if request.param == "wan":
        load_pretrained(model, pretrained_folder)
    # Outputs begin at zero, which would make every precision exact.
    with torch.no_grad():
        for part in (model.tactile, model.video if request.param == "tiny" else None):
            if part is not None:
                part.predict.weight.add_(0.1 * torch.randn(part.predict.weight.shape))
                part.modulate[1].weight.add_(0.1 * torch.randn(part.modulate[1].weight.shape))
    return model


@pytest.fixture
def episode(model, toy_episode, large_episode):
    return toy_episode(0) if model.config.wan is None else large_episode(0)


def _predicted(model, request):
    inputs = build_inputs([request], model.config)
    noise = model.noise(17, torch.Generator().manual_seed(0))
    return model.predict(inputs, noise)


@pytest.mark.long
def test_bfloat16_weights_predict_nearly_the_same(model, episode):
    request = episode.cut(WindowPosition(0, 0, 17, action_kind="commanded")).request
    exact = _predicted(model, request)
    half = _predicted(model.to(torch.bfloat16), request)
    assert half.images.dtype == half.tactile_kpa.dtype == torch.float32
    for name, limit in (("images", 0.02), ("tactile_kpa", 0.05)):
        got, expected = getattr(half, name), getattr(exact, name)
        error = (got - expected).norm() / expected.norm().clamp_min(1e-6)
        assert 0.0 < error < limit, name


def test_only_what_loses_little_is_converted(model):
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    model.to(torch.bfloat16)
    after = model.state_dict()
    exact = {name for name, tensor in after.items() if tensor.dtype != torch.bfloat16}
    assert all(torch.equal(after[name], before[name]) for name in exact)
    assert {name.split(".")[0] for name in after.keys() - exact} == {"video", "tactile", "layers"}
    in_layers = {name for name in exact if name.startswith("layers.")}
    expected = set()
    if model.config.wan is not None:
        parts = ("scale_shift_table", "norm2.weight", "norm2.bias")
        expected = {f"layers.{n}.video.block.{part}" for n in range(2) for part in parts}
    assert in_layers == expected
    model.float()
    assert all(tensor.dtype == before[name].dtype for name, tensor in model.state_dict().items())


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.slow
def test_training_and_prediction_follow_the_model_to_its_device(model, episode, dtype):
    # The meta device computes shapes only, and refuses tensors of any other device.
    away = model.to("meta").to(dtype)
    sampler = WindowSampler([episode], np.random.default_rng(0), max_steps=17)
    batch = sampler.draw(2, 17)
    loss = losses(
        away, batch, generator=torch.Generator().manual_seed(0),
        options=LossOptions(context_noise=0.1, touch_loss="contact_or_changing"),
    )  # fmt: skip
    torch.autograd.backward(loss.video + loss.tactile)
    assert loss.video.is_meta
    noise = away.noise(17, torch.Generator().manual_seed(0))
    future = away.predict(build_inputs(batch.requests[:1], away.config), noise)
    assert future.images.is_meta
    assert future.images.shape == (1, 16, away.config.image_px, away.config.image_px, 3)
