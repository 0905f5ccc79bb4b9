"""The plan of memory and FLOPs, against counts by hand and measurements of real runs."""

from dataclasses import replace

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode
from transformers import UMT5Config, UMT5EncoderModel

from services.networks.weight_files import memory_of
from services.world_model import plan
from services.world_model.network.configuration import NetworkConfig, WanConfig
from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import JointWorldModel
from services.world_model.paper_settings import LoraSettings, TrainCommand
from services.world_model.plan import (
    PeakMemory,
    _inputs,
    _latents,
    _pass,
    _plan_of,
    plan_of,
    plan_table,
    training_plan,
    training_table,
)
from services.world_model.pretrained_video import load_pretrained
from services.world_model.training.joint_dataset import WindowPosition
from services.world_model.training.joint_objective import errors, examples_of
from services.world_model.training.joint_trainer import TrainingRun
from tests.unit.world_model.wan.test_end_to_end import settings
from tests.unit.world_model.wan.test_trained_parts import changed

__all__ = ["settings"]

KIB = 1024
# The text encoder of Wan: layers and widths of UMT5-XXL.
UMT5_XXL = {
    "vocab_size": 256384, "d_model": 4096, "d_kv": 64, "d_ff": 10240, "num_layers": 24,
    "num_heads": 64,
}  # fmt: skip


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


def test_equal_operations_make_tensors_of_their_own():
    counts = torch.zeros(KIB, dtype=torch.int64, device="meta")
    for _ in range(2):
        with PeakMemory([counts]) as memory:
            more = [counts + 1 for _ in range(3)]  # 24 KiB
            for one in more:
                one.add_(1)
            same = [torch.ops.aten._unsafe_view(one, (2, -1)) for one in more]
            real, one = counts + 1.0, counts.sum(dim=0, keepdim=True)  # 4 KiB and 8 bytes
        assert memory.peak_bytes == 28 * KIB + 8
        assert [view.untyped_storage() for view in same] == [x.untyped_storage() for x in more]
        assert (real.dtype, one.dtype, one.shape) == (torch.float32, torch.int64, (1,))


def test_processes_and_choices_share_passes(full_config):
    settings = TrainCommand(preset="wan22-5b", episodes="unused")
    wan = full_config.wan.model_copy(update={"precision": "float32"})
    network = full_config.model_copy(update={"wan": wan, "num_layers": 9})
    _pass.cache_clear()
    training_table(settings.model_copy(update={"network": network}), 8)
    # As given, recomputing, in half precision, and with adapters; of eight processes as of one.
    assert _pass.cache_info().misses == 4


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

        def shared():
            context = model.context(inputs, first)  # noqa: B023
            return replace(context, clean=model.clean_tokens(context, noise))  # noqa: B023

        context = shared()
        jobs = {
            "encode the first image": lambda: model.first_latents(inputs),  # noqa: B023
            "what sampler steps share": shared,
            "one sampler step": lambda: model.denoise(context, noise, torch.ones(1)),  # noqa: B023
            "decode all images": lambda: model.decode(first, noise),  # noqa: B023
        }
        planned = {work.name: work for work in plan_of(config).work}
        for name, job in jobs.items():
            # The plan does not count on fused attention, which the counter does not know either.
            with sdpa_kernel(SDPBackend.MATH):
                with torch.no_grad(), FlopCounterMode(display=False) as counter:
                    job()
                measured = _peak_of_allocator(job)
            assert planned[name].flops == counter.get_total_flops(), name
            if config.wan is None or "sampler" in name:
                assert abs(planned[name].memory_bytes / measured - 1.0) < 0.35, name
            else:
                # Convolutions of processors take working memory beside their tensors.
                assert 0.2 * measured < planned[name].memory_bytes < 1.1 * measured, name


def test_inputs_are_no_memory_of_what_sampler_steps_share():
    config = NetworkConfig(num_layers=1)
    with torch.device("meta"), torch.no_grad():
        model = JointWorldModel(config).eval()
        inputs, (first, noisy) = (
            _inputs(config, config.max_steps),
            _latents(model, config.max_steps),
        )
        with PeakMemory((*model.parameters(), *model.buffers())) as memory:
            model.clean_tokens(model.context(inputs, first), noisy)
    shared = next(work for work in plan_of(config).work if "share" in work.name)
    # The context holds the raster as it came.
    assert shared.memory_bytes <= memory.peak_bytes - inputs.raster.nbytes


def _resized(request, px):
    image = torch.zeros(px, px, 3, dtype=torch.uint8).numpy()
    return type(request)(**{**vars(request), "first_image": image})


def _peak_of_allocator(job, mode=torch.no_grad):
    """Largest sum of allocations less releases that torch's profiler sees."""
    with mode(), profile(activities=[ProfilerActivity.CPU], profile_memory=True) as run:
        job()
    now, peak = 0, 0
    events = [e for e in run.profiler.kineto_results.events() if e.name() == "[memory]"]
    for event in sorted(events, key=lambda e: e.start_ns()):
        now += event.nbytes()
        peak = max(peak, now)
    return peak


@pytest.mark.parametrize("past_images", [0, 2])
def test_a_deep_model_is_planned_from_few_layers(full_config, past_images):
    wan = full_config.wan.model_copy(update={"precision": "bfloat16"})
    more = {"num_layers": 7, "past_images": past_images, "wan": wan}
    deep = full_config.model_copy(update=more)
    assert plan_of(deep) == _of_all_layers(deep)
    # Of a small network the peak may be elsewhere with few layers.
    small = NetworkConfig(num_layers=7, past_images=past_images)
    few, traced = plan_of(small), _of_all_layers(small)
    assert (few.parts, few.kept_bytes) == (traced.parts, traced.kept_bytes)
    for work, all_layers in zip(few.work, traced.work, strict=True):
        assert replace(work, memory_bytes=0) == replace(all_layers, memory_bytes=0)
        assert work.memory_bytes == pytest.approx(all_layers.memory_bytes, rel=0.03)


def _of_all_layers(config):
    with torch.device("meta"):
        return _plan_of(JointWorldModel(config))


@pytest.mark.slow
def test_the_full_size_fits_one_card_in_half_precision():
    config = NetworkConfig(
        video_expert="wan", wan=WanConfig(), image_px=256, patch_px=16, codec_channels=48,
        video_width=3072, num_heads=24, head_width=128, num_layers=30, tactile_width=512,
        ffn_ratio=4, use_pose_raster=False, prediction="velocity", video_target="plain",
    )  # fmt: skip
    full = plan_of(config)
    assert (full.num_video_tokens, full.num_tactile_tokens) == (5 * 64, 17 * 2)
    weights = {part.name: part.num_weights for part in full.parts}
    # Pretrained, actions 268 to 3072 to 3072, and one vector for commanded actions.
    assert weights["video expert"] == 4_999_787_712 + 269 * 3072 + 3073 * 3072 + 3072
    assert weights["visual codec"] == 704_688_668
    with torch.device("meta"):
        encoder = UMT5EncoderModel(UMT5Config(**UMT5_XXL))
    # Parameters that are shared come once.
    num_weights = sum(weight.numel() for weight in encoder.parameters())
    assert weights["text encoder (once per instruction)"] == num_weights
    # Keys and values of 64 + 2 clean tokens and 512 words in 30 layers, two bytes each.
    assert full.kept_bytes == pytest.approx(3072 * 2 * 30 * (66 + 512) * 2, rel=0.03)
    assert full.peak_bytes < 40e9


@pytest.mark.slow
def test_the_table_has_both_precisions_of_the_full_size(full_config):
    table = plan_table(full_config)
    assert "one action chunk of 16 steps, 20 video and 34 tactile tokens" in table
    assert "float32" in table
    assert "bfloat16" in table
    assert "bfloat16" not in plan_table(NetworkConfig())


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"recompute": True},
        {"accumulate": 2},
        {"recompute": True, "lora": LoraSettings(rank=4)},
        {"freeze_video": True},
    ],
    ids=str,
)
def test_a_planned_training_takes_what_the_allocator_sees(settings, large_episode, changes):
    given = changed(settings, **changes)
    planned = training_plan(given)
    run = TrainingRun([large_episode(0)], given)
    assert planned.weights == memory_of(run.model.state_dict())
    assert planned.learned == memory_of(run.learned)
    batch = next(run._batches())
    run.learn(batch)  # now there are moments and gradients
    state = [*run.loop.optimizer.state.values()]
    moments = sum(memory_of({n: t for n, t in one.items() if t.ndim}) for one in state)
    assert moments + memory_of(run._averages) == planned.copies * planned.learned
    run.loop.optimizer.zero_grad()
    num_parts, generator = given.accumulate, torch.Generator().manual_seed(0)
    examples = examples_of(run.model, batch, generator=generator, num_parts=num_parts)

    def step():
        for part in examples.parts(num_parts):
            loss = errors(run.model, part, "float32")
            torch.autograd.backward(loss.video + loss.tactile)

    with sdpa_kernel(SDPBackend.MATH):
        measured = _peak_of_allocator(step, torch.enable_grad)
    assert planned.step == pytest.approx(measured, rel=0.2)


@pytest.mark.slow
def test_plans_of_few_layers_are_those_of_all(settings, monkeypatch):
    wide = changed(settings, recompute=True, lora=LoraSettings(rank=4))
    for given in (changed(settings), wide):
        deep = given.model_copy(
            update={"network": given.network.model_copy(update={"num_layers": 9})}
        )
        for count in (1, 2):
            few = training_plan(deep, count)
            with monkeypatch.context() as patch:
                patch.setattr(plan, "_FEW_LAYERS", 9)
                _pass.cache_clear()
                whole = training_plan(deep, count)
                _pass.cache_clear()
            assert replace(few, step=whole.step) == whole
            assert few.step == pytest.approx(whole.step, rel=0.05)


@pytest.mark.slow
def test_trainings_that_fit_cards_are_named(full_config):
    full = training_table(TrainCommand(preset="wan22-5b", episodes="unused"), 8)
    assert "fits 24 GB, in one process: --recompute --network.wan.precision bfloat16 --lora" in full
    assert "fits 80 GB, in one process: --recompute --network.wan.precision bfloat16\n" in full
    assert "fits 141 GB, in one process: as given" in full
    given = TrainCommand(preset="wan22-5b-lora", episodes="unused")
    lora = training_plan(given)
    # Adapters of rank 32 beside touch and actions, in float32; all else is frozen.
    assert lora.learned < 1.5e9
    assert lora.weights + 4 * lora.learned < lora.peak_bytes < 21e9
    eight = training_plan(given, 8)
    shared = (eight.weights - eight.whole + 4 * eight.learned) // 8
    assert eight.peak_bytes > eight.whole + shared + eight.outer + 3 * eight.layer
    assert eight.peak_bytes < 8e9
