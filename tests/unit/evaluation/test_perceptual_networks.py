"""LPIPS, CLIP and DINO metrics with tiny or random weights, against their definitions in numpy."""

import shutil

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from dextouch.errors import DexTouchError, InvalidInputError, NotFoundError
from services.evaluation.perceptual_networks import NO_WEIGHTS, PerceptualNetworks, heat_maps
from services.evaluation.prediction import all_metrics

RNG = np.random.default_rng(0)
SIZES = ((64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3))
# Places of the convolutions in torchvision's AlexNet.
PLACES = (0, 3, 6, 8, 10)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection, ViTConfig, ViTModel

    folder = tmp_path_factory.mktemp("weights")
    generator = torch.Generator().manual_seed(0)
    backbone, heads = {}, {}
    for layer, (place, (out, inner, kernel)) in enumerate(zip(PLACES, SIZES, strict=True)):
        scale = (2.0 / (inner * kernel**2)) ** 0.5
        shape = (out, inner, kernel, kernel)
        backbone[f"features.{place}.weight"] = scale * torch.randn(shape, generator=generator)
        backbone[f"features.{place}.bias"] = 0.1 * torch.randn(out, generator=generator)
        heads[f"lin{layer}.model.1.weight"] = torch.rand((1, out, 1, 1), generator=generator)
    # The classifier comes along in torchvision's file and is not used.
    backbone["classifier.1.weight"] = torch.zeros(2, 2)
    for name in ("lpips", "aesthetic"):
        (folder / name).mkdir()
    save_file(backbone, folder / "lpips" / "alexnet.safetensors")
    save_file(heads, folder / "lpips" / "heads.safetensors")
    head = {"weight": torch.randn(1, 8, generator=generator), "bias": torch.ones(1)}
    save_file(head, folder / "aesthetic" / "head.safetensors")
    torch.manual_seed(0)
    sizes = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1,
             "num_attention_heads": 2, "patch_size": 112, "image_size": 224}  # fmt: skip
    CLIPVisionModelWithProjection(CLIPVisionConfig(**sizes, projection_dim=8)).save_pretrained(
        folder / "clip"
    )
    ViTModel(ViTConfig(**sizes)).save_pretrained(folder / "dino")
    return folder


def convolved(maps, kernel, bias, stride, padding):
    padded = np.pad(maps, ((0, 0), (padding,) * 2, (padding,) * 2))
    size = kernel.shape[-1]
    windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size), axis=(1, 2))
    found = np.einsum("ihwyx,oiyx->ohw", windows[:, ::stride, ::stride], kernel)
    return found + bias[:, None, None]


def pooled(maps):
    windows = np.lib.stride_tricks.sliding_window_view(maps, (3, 3), axis=(1, 2))
    return windows[:, ::2, ::2].max(axis=(-2, -1))


def plain_lpips(first, second, folder):
    from safetensors.numpy import load_file

    backbone = load_file(folder / "lpips" / "alexnet.safetensors")
    heads = load_file(folder / "lpips" / "heads.safetensors")
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    sides = [
        ((2 * (image / 255.0) - 1 - shift) / scale).transpose(2, 0, 1) for image in (first, second)
    ]
    total = 0.0
    for layer, (stride, padding) in enumerate(((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))):
        kernel = backbone[f"features.{PLACES[layer]}.weight"].astype(np.float64)
        bias = backbone[f"features.{PLACES[layer]}.bias"]
        sides = [np.maximum(convolved(one, kernel, bias, stride, padding), 0.0) for one in sides]
        units = [one / np.maximum(np.sqrt((one**2).sum(0)), 1e-10) for one in sides]
        head = heads[f"lin{layer}.model.1.weight"][0, :, 0, 0]
        total += (head[:, None, None] * (units[0] - units[1]) ** 2).sum(axis=0).mean()
        if layer < 2:
            sides = [pooled(one) for one in sides]
    return total


@pytest.mark.long
def test_lpips_is_its_definition(weights):
    images = RNG.integers(0, 256, size=(2, 3, 64, 71, 3), dtype=np.uint8)
    found = PerceptualNetworks(weights).perceptual_distance(*images)
    expected = [plain_lpips(a, b, weights) for a, b in zip(*images, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert not PerceptualNetworks(weights).perceptual_distance(images[0], images[0]).any()


def test_lpips_refuses_images_that_are_too_small(weights):
    small = np.zeros((1, 62, 80, 3), dtype=np.uint8)
    with pytest.raises(InvalidInputError, match=r"\(62, 80\) px, expected at least 63"):
        PerceptualNetworks(weights).perceptual_distance(small, small)


def test_aesthetic_quality_is_the_head_on_unit_features(weights):
    from safetensors.numpy import load_file
    from transformers import CLIPVisionModelWithProjection

    images = RNG.integers(0, 256, size=(3, 224, 224, 3), dtype=np.uint8)
    mean, std = [0.48145466, 0.4578275, 0.40821073], [0.26862954, 0.26130258, 0.27577711]
    pixels = ((images / 255.0 - mean) / std).transpose(0, 3, 1, 2)
    network = CLIPVisionModelWithProjection.from_pretrained(weights / "clip")
    with torch.no_grad():
        output = network(pixel_values=torch.tensor(pixels, dtype=torch.float32))
    features = output.image_embeds.double().numpy()
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    head = load_file(weights / "aesthetic" / "head.safetensors")
    expected = (features @ head["weight"][0] + head["bias"]) / 10
    found = PerceptualNetworks(weights).aesthetic_quality(images)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_subject_consistency_is_the_mean_of_two_cosines(weights):
    from transformers import ViTModel

    images = RNG.integers(0, 256, size=(4, 224, 224, 3), dtype=np.uint8)
    pixels = (images / 255.0 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    network = ViTModel.from_pretrained(weights / "dino")
    with torch.no_grad():
        output = network(pixel_values=torch.tensor(pixels.transpose(0, 3, 1, 2)).float())
    tokens = output.last_hidden_state[:, 0].double().numpy()
    total = 0.0
    for index in range(1, 4):
        for other in (index - 1, 0):
            cosine = tokens[index] @ tokens[other]
            cosine /= np.linalg.norm(tokens[index]) * np.linalg.norm(tokens[other])
            total += max(cosine, 0.0) / 2
    found = PerceptualNetworks(weights).subject_consistency(images)
    assert found == pytest.approx(total / 3, rel=1e-4)


def test_metrics_are_available_where_their_weights_are(weights, tmp_path):
    here = {name for name, metric in all_metrics(weights).items() if not metric.missing}
    nowhere = {name for name, metric in all_metrics(tmp_path).items() if not metric.missing}
    assert here - nowhere == {"lpips", "tactile_lpips", "aesthetic_quality", "subject_consistency"}
    assert all_metrics()["lpips"].missing == NO_WEIGHTS
    assert "not published" in all_metrics(weights)["semantic_alignment"].missing


def test_files_that_do_not_fit_are_named(weights, tmp_path):
    (tmp_path / "lpips").mkdir()
    image = np.zeros((1, 64, 64, 3), dtype=np.uint8)
    with pytest.raises(NotFoundError, match=r"no file alexnet\.safetensors"):
        PerceptualNetworks(tmp_path).perceptual_distance(image, image)
    save_file({"features.0.weight": torch.zeros(1)}, tmp_path / "lpips" / "alexnet.safetensors")
    save_file({"lin0.model.1.weight": torch.zeros(1)}, tmp_path / "lpips" / "heads.safetensors")
    with pytest.raises(InvalidInputError, match=r"alexnet\.safetensors"):
        PerceptualNetworks(tmp_path).perceptual_distance(image, image)


@pytest.mark.parametrize("change", ["absent", "shape", "damaged", "empty"])
@pytest.mark.parametrize("name", ["clip", "dino", "aesthetic"])
def test_no_weights_are_made_up(weights, tmp_path, name, change):
    shutil.copytree(weights, tmp_path / "w")
    (path,) = (tmp_path / "w" / name).glob("*.safetensors")
    tensors = load_file(path)
    first = sorted(tensors)[0]
    if change == "absent":
        del tensors[first]
    elif change == "shape":
        tensors[first] = torch.zeros(3, 5)
    save_file(tensors, path, {"format": "pt"})
    if change == "damaged":
        path.write_bytes(path.read_bytes()[:-50])
    elif change == "empty":
        path.unlink()
    networks = PerceptualNetworks(tmp_path / "w")
    measure = networks.subject_consistency if name == "dino" else networks.aesthetic_quality
    with pytest.raises(DexTouchError, match="head" if name == "aesthetic" else f"folder {name}"):
        measure(np.zeros((2, 64, 64, 3), dtype=np.uint8))


def test_heat_maps_are_large_enough_and_differ_where_touch_does():
    touch = np.zeros((2, 2, 320), dtype=np.float32)
    touch[1, 1, 100] = 20.0
    maps = heat_maps(touch)
    assert min(maps.shape[1:3]) >= 63
    assert (maps[0] != maps[1]).any(axis=2).sum() == 16
