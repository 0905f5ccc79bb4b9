"""Quick shapes of the meta device: torch's own rules are the reference."""

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from services.world_model import meta_device
from services.world_model.meta_device import MetaTrace
from services.world_model.network.configuration import NetworkConfig, WanConfig
from services.world_model.plan import _plan_of, _step_bytes

WIDE = WanConfig(
    ffn_width=32, time_width=16, text_width=32, text_tokens=12, lora_rank=2, precision="bfloat16"
)
FULL = NetworkConfig(
    video_expert="wan", wan=WIDE, image_px=256, patch_px=16, codec_channels=48, video_width=24,
    num_heads=2, head_width=12, num_layers=2, tactile_width=16, ffn_ratio=2, use_pose_raster=False,
    add_condition_to_tokens=False, prediction="velocity", video_target="plain",
    tokenizer="split_hands", tactile_tokens="pad", past_images=2,
    further_views=("camera_wrist_left",),
)  # fmt: skip
TINY = NetworkConfig(use_contact_geometry=True, action_conditioning="cross_attention")


def forms(result):
    """Shape, kind and strides, which mean nothing along an axis of one."""
    return [
        (x.shape, x.dtype, [s for s, n in zip(x.stride(), x.shape, strict=True) if n > 1])
        for x in meta_device.tree_leaves(result)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("config", [FULL, TINY], ids=["wan", "tiny"])
def test_quick_rules_are_those_of_torch(config, monkeypatch):
    computed, compared, reference = meta_device._computed, set(), []

    def both(func, args, kwargs):
        got, expected = computed(func, args, kwargs), func(*args, **kwargs)
        assert forms(got) == forms(expected), (func, args, kwargs)
        compared.add(func.overloadpacket)
        # Alive until the end, so that no storage is taken for another.
        reference.append(expected)
        return got

    monkeypatch.setattr(meta_device, "_computed", both)
    monkeypatch.setattr(MetaTrace, "_known", {})
    _plan_of(config, 2)
    for recompute in (False, True):
        _step_bytes.__wrapped__(config, 2, 2, is_frozen=False, recompute=recompute)
    assert {torch.ops.aten.mm, torch.ops.aten.native_layer_norm_backward} < compared


def test_flops_are_those_that_torch_counts():
    a, b = torch.ones(2, 3, 4, device="meta"), torch.ones(2, 4, 5, device="meta")
    with FlopCounterMode(display=False) as counter:
        a @ b
    for _ in range(2):
        with MetaTrace() as trace:
            a @ b
        assert trace.flops == counter.get_total_flops() == 2 * 2 * 3 * 4 * 5


def test_what_is_disregarded_counts_in_one_peak_alone():
    with MetaTrace() as trace:
        kept = torch.zeros(256, device="meta")
        trace.disregard(kept)
        trace.disregard(kept)
        other = torch.zeros(512, device="meta")
        del kept
        torch.zeros(256, device="meta")
    assert (trace.peak_bytes, trace.regarded_peak_bytes) == (3 * 1024, 3 * 1024)
    with MetaTrace() as trace:
        trace.disregard(other := torch.zeros(256, device="meta"))
        torch.zeros(512, device="meta")
    assert other.shape == (256,)
    assert (trace.peak_bytes, trace.regarded_peak_bytes) == (3 * 1024, 2 * 1024)
