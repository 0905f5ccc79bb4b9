"""What later chunks share with earlier ones changes nothing: texts, first latents, clean tokens."""

from dataclasses import replace

import pytest
import torch

from services.world_model.network.inputs import build_inputs
from services.world_model.network.instruction import LastUsed
from services.world_model.network.model import JointWorldModel, Sampling
from services.world_model.pretrained_video import load_pretrained
from services.world_model.training.joint_dataset import WindowPosition
from tests.unit.world_model.test_clean_tokens import noise_of

TEXTS = ("push the box", "stand", "push the box")
SAMPLING = Sampling(3, "unipc")


@pytest.fixture
def models(full_config, pretrained_folder):
    """A model that keeps two contexts, and one of the same weights that keeps none."""
    torch.manual_seed(0)
    config = full_config.model_copy(update={"use_scene_encoder": False})
    keeping = JointWorldModel(config)
    load_pretrained(keeping, pretrained_folder)
    for parameter in [*keeping.tactile.parameters(), *keeping.video_condition.actions.parameters()]:
        parameter.data.add_(0.1 * torch.randn(parameter.shape))
    keeping.eval().requires_grad_(requires_grad=False)
    forgetting = JointWorldModel(config).eval()
    forgetting.load_state_dict(keeping.state_dict(), assign=True)
    forgetting.text_features.use(pretrained_folder)
    keeping.keep_contexts(2)
    return keeping, forgetting


@pytest.fixture
def requests(large_episode):
    """Three windows; the last begins as the first, and has other actions."""
    cut = [large_episode(seed).cut(WindowPosition(0, 0, 17)).request for seed in (0, 1)]
    other = cut[0].actions.copy()
    other[1:] = cut[0].actions[:-1]
    cut.append(replace(cut[0], actions=other))
    return [replace(one, instruction=text) for one, text in zip(cut, TEXTS, strict=True)]


def futures(model, requests, sampling=SAMPLING):
    inputs = build_inputs(requests, model.config)
    return model.predict(inputs, noise_of(model, len(requests)), sampling=sampling)


def assert_equal(got, expected):
    torch.testing.assert_close(got.images, expected.images, rtol=0, atol=1e-5)
    scale = max(1.0, float(expected.tactile_kpa.max()))
    torch.testing.assert_close(got.tactile_kpa, expected.tactile_kpa, rtol=0, atol=1e-5 * scale)


def test_chunks_that_share_contexts_are_equal(models, requests):
    keeping, forgetting = models
    order = ([0], [0], [2], [1], [0, 1, 2], [2, 1], [1, 1])
    for rows in order:
        asked = [requests[row] for row in rows]
        assert_equal(futures(keeping, asked), futures(forgetting, asked))
    free = Sampling(3, "unipc", guidance=2.0)
    assert_equal(futures(keeping, requests, free), futures(forgetting, requests, free))


def test_texts_images_and_clean_tokens_are_computed_once(models, requests):
    keeping, _ = models
    counts = {"text": 0, "image": 0, "tokens": []}

    def count(name):
        return lambda *_: counts.update({name: counts[name] + 1})

    keeping.video_condition.embedder.text_embedder.register_forward_hook(count("text"))
    keeping.codec.autoencoder.encoder.register_forward_hook(count("image"))
    block = keeping.layers[1].video.block
    block.attn1.to_q.register_forward_hook(
        lambda _, given, __: counts["tokens"].append(given[0].shape[:2])
    )
    block.attn2.to_k.register_forward_hook(lambda *_: counts["tokens"].append("text"))
    futures(keeping, requests[:1])
    assert counts == {"text": 1, "image": 1, "tokens": [(1, 4), "text", *[(1, 16)] * 3]}
    counts["tokens"].clear()
    # The same observed step, other actions.
    futures(keeping, requests[2:])
    assert counts == {"text": 1, "image": 1, "tokens": [(1, 16)] * 3}
    counts["tokens"].clear()
    futures(keeping, requests)
    assert counts == {"text": 2, "image": 2, "tokens": [(1, 4), "text", *[(3, 16)] * 3]}


def test_the_least_recently_used_value_makes_room():
    kept, computed = LastUsed(2), []

    def values(keys):
        return kept.of(keys, lambda rows: computed.extend(rows) or [keys[row] * 2 for row in rows])

    assert values([1, 2, 1]) == [2, 4, 2]
    assert computed == [0, 1]
    assert values([1]) == [2]
    assert values([3, 1, 4]) == [6, 2, 8]
    assert computed == [0, 1, 0, 2]
    computed.clear()
    assert values([1, 4]) == [2, 8]
    assert values([2]) == [4]
    assert computed == [0]
