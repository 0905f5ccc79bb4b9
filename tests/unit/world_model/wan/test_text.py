"""Text features of instructions."""

import pytest
import torch
from safetensors.torch import load_file, save_file

from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError
from services.world_model.network.instruction import TextFeatures, cleaned, key_of

# "push the box </s>" by the tokenizer of the fixture.
IDS = torch.tensor([[3, 4, 5, 1]])


@pytest.fixture
def features(wan_config, pretrained_folder):
    made = TextFeatures(wan_config)
    made.use(pretrained_folder)
    return made


def test_features_are_those_of_the_encoder_padded_with_zeros(features, text_encoder, wan_config):
    expected = text_encoder(IDS, torch.ones_like(IDS)).last_hidden_state[0]
    stacked = features.stack(["push the box", "stand"])
    assert stacked.shape == (2, wan_config.text_tokens, wan_config.text_width)
    torch.testing.assert_close(stacked[0, :4], expected, rtol=0, atol=1e-6)
    assert stacked[0, 4:].abs().max() == 0
    assert stacked[1, 2:].abs().max() == 0
    assert stacked[1, :2].abs().max() > 0


def test_long_texts_are_cut_and_spaces_do_not_matter(features, wan_config):
    assert len(features.of("box " * 50)) == wan_config.text_tokens
    assert cleaned("  push\n the &amp;lt; box ") == "push the < box"
    assert torch.equal(features.of(" push   the box"), features.of("push the box"))
    assert key_of("push  the box") == key_of("push the box") != key_of("push the hands")


def test_each_text_is_encoded_once(features, wan_config, pretrained_folder, tmp_path, monkeypatch):
    features.use(pretrained_folder, tmp_path / "cache")
    first = features.of("push the box")
    monkeypatch.setattr(features, "_encode", lambda _: pytest.fail("encoded again"))
    assert features.of("push the box") is first
    other = TextFeatures(wan_config)
    other.use(None, tmp_path / "cache")
    assert torch.equal(other.of("push the box"), first)
    known = TextFeatures(wan_config)
    known.learn(features.known)
    assert torch.equal(known.of("push the box"), first)
    with pytest.raises(InvalidInputError, match=r"'stand'.*--wan\.folder"):
        known.of("stand")


def test_a_foreign_or_damaged_cache_is_refused(features, pretrained_folder, tmp_path, wan_config):
    features.use(pretrained_folder, tmp_path)
    features.of("stand")
    (file,) = tmp_path.iterdir()
    assert load_file(file)["features"].shape == (2, wan_config.text_width)
    for tensors in ({"features": torch.zeros(2, 7)}, {"other": torch.zeros(2, 32)}):
        save_file(tensors, file)
        other = TextFeatures(wan_config)
        other.use(None, tmp_path)
        with pytest.raises(CorruptDataError, match="remove the file"):
            other.of("stand")


def test_a_folder_without_text_encoder_is_named(wan_config, tmp_path):
    features = TextFeatures(wan_config)
    features.use(tmp_path)
    with pytest.raises(NotFoundError, match="no folder text_encoder"):
        features.of("stand")
