"""The plan of memory and FLOPs, against counts by hand and measurements of real runs."""

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from services.world_model.network.configuration import NetworkConfig, WanConfig
from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import JointWorldModel
from services.world_model.plan import PeakMemory, plan_of, plan_table
from services.world_model.pretrained_video import load_pretrained
from services.world_model.training.dataset import WindowPosition

KIB = 1024


def test_peak_memory_of_a_calculation_by_hand():
    weight = torch.zeros(KIB, device="meta")
    with PeakMemory([weight]) as memory:
        a = weight + 1  # 4 KiB
        b = torch.cat([a, a])  # 12 KiB
        del a  # 8 KiB
        c = b.view(2, KIB).t()  # a view costs nothing
        d = c.to(torch.float64)  # 24 KiB
        del b, c, d
        e = weight.double()  # 8 KiB
    assert memory.peak_bytes == 24 * KIB
    assert e.shape == (KIB,)


@pytest.mark.slow
def test_flops_of_one_more_layer_by_hand(full_config):
    def step(config):
        return next(work.flops for work in plan_of(config).work if work.name == "one sampler step")

    deeper = full_config.model_copy(update={"num_layers": full_config.num_layers + 1})
    # Tokens after the first latent frame and the first touch; the clean ones are kept.
    video, touch, clean, dim, ffn, words = 16, 32, 6, 24, 32, 12
    # q, k, v, o and the feed-forward network; text: q and o of tokens. Its k and v are kept.
    wan = video * (4 * dim * dim + 2 * dim * ffn + 2 * dim * dim)
    tactile = touch * (4 * 16 * dim + 2 * 16 * 32)
    attention = (video + touch) * (video + touch + clean) * dim * 2 + video * words * dim * 2
    assert step(deeper) - step(full_config) == 2 * (wan + tactile + attention)


@pytest.mark.long
def test_a_plan_without_weights_is_what_a_run_measures(
    full_config, pretrained_folder, toy_episode, tiny_config
):
    full = JointWorldModel(full_config).eval()
    load_pretrained(full, pretrained_folder)
    for model in (full, JointWorldModel(tiny_config).eval()):
        config = model.config
        episode = toy_episode(0)
        request = episode.cut(WindowPosition(0, 0, 17)).request
        inputs = build_inputs([_resized(request, config.image_px)], config)
        first = model.first_latents(inputs)
        noise = model.noise(17, torch.Generator().manual_seed(0))
        context = model.with_clean_tokens(model.context(inputs, first), noise)
        jobs = {
            "encode the first image": lambda: model.first_latents(inputs),  # noqa: B023
            "what sampler steps share": lambda: model.with_clean_tokens(  # noqa: B023
                model.context(inputs, first),  # noqa: B023
                noise,  # noqa: B023
            ),
            "one sampler step": lambda: model.denoise(context, noise, torch.ones(1)),  # noqa: B023
            "decode all images": lambda: model.decode(first, noise),  # noqa: B023
        }
        plan = {work.name: work for work in plan_of(config).work}
        for name, job in jobs.items():
            # The plan does not count on fused attention, which the counter does not know either.
            with sdpa_kernel(SDPBackend.MATH):
                with torch.no_grad(), FlopCounterMode(display=False) as counter:
                    job()
                measured = _peak_of_allocator(job)
            assert plan[name].flops == counter.get_total_flops(), name
            if config.wan is None or "sampler" in name:
                assert abs(plan[name].memory_bytes / measured - 1.0) < 0.35, name
            else:
                # Convolutions of processors take working memory beside their tensors.
                assert 0.2 * measured < plan[name].memory_bytes < 1.1 * measured, name


def _resized(request, px):
    image = torch.zeros(px, px, 3, dtype=torch.uint8).numpy()
    return type(request)(**{**vars(request), "first_image": image})


def _peak_of_allocator(job):
    """Largest sum of allocations less releases that torch's profiler sees."""
    with torch.no_grad(), profile(activities=[ProfilerActivity.CPU], profile_memory=True) as run:
        job()
    now, peak = 0, 0
    events = [e for e in run.profiler.kineto_results.events() if e.name() == "[memory]"]
    for event in sorted(events, key=lambda e: e.start_ns()):
        now += event.nbytes()
        peak = max(peak, now)
    return peak


@pytest.mark.slow
def test_the_full_size_fits_one_card_in_half_precision():
    config = NetworkConfig(
        video_expert="wan", wan=WanConfig(), image_px=256, patch_px=16, codec_channels=48,
        video_width=3072, num_heads=24, head_width=128, num_layers=30, tactile_width=512,
        ffn_ratio=4, use_pose_raster=False, prediction="velocity", video_target="plain",
    )  # fmt: skip
    plan = plan_of(config)
    assert (plan.num_video_tokens, plan.num_tactile_tokens) == (5 * 64, 17 * 2)
    weights = {part.name: part.num_weights for part in plan.parts}
    # Pretrained, actions 268 to 3072 to 3072, and one vector for commanded actions.
    assert weights["video expert"] == 4_999_787_712 + 269 * 3072 + 3073 * 3072 + 3072
    assert weights["visual codec"] == 704_688_668
    assert weights["text encoder (once per instruction)"] == 5_680_910_336
    # Keys and values of 64 + 2 clean tokens and 512 words in 30 layers, two bytes each.
    assert plan.kept_bytes == pytest.approx(3072 * 2 * 30 * (66 + 512) * 2, rel=0.03)
    assert plan.peak_bytes < 40e9


@pytest.mark.slow
def test_the_table_has_both_precisions_of_the_full_size(full_config):
    table = plan_table(full_config)
    assert "one action chunk of 16 steps, 20 video and 34 tactile tokens" in table
    assert "float32" in table
    assert "bfloat16" in table
    assert "bfloat16" not in plan_table(NetworkConfig())
