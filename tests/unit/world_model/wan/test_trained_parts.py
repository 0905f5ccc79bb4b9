"""What is trained of the full architecture, and in how little memory: results stay the same."""

import numpy as np
import pytest
import torch
from safetensors import safe_open
from torch import distributed, nn
from torch.distributed.tensor import DTensor
from torch.testing._internal.distributed.fake_pg import FakeStore

from dextouch.errors import ConflictError, CorruptDataError, InvalidInputError
from services.networks.weight_files import memory_of, read_tensors, write_tensors
from services.world_model.checkpoints import read_checkpoint
from services.world_model.network.model import JointWorldModel
from services.world_model.network.video import AdaptedLinear, is_adapter
from services.world_model.paper_settings import LoraSettings, TrainCommand
from services.world_model.pretrained_video import freeze_pretrained, is_pretrained
from services.world_model.training.distribution import Processes, joined_processes
from services.world_model.training.joint_objective import errors, examples_of
from services.world_model.training.joint_trainer import TrainingRun, train_on
from services.world_model.training.resume_files import state_path
from tests.unit.world_model.test_distribution import sharded
from tests.unit.world_model.wan.test_end_to_end import settings

__all__ = ["settings", "sharded"]

LORA = {"lora": LoraSettings(rank=4, alpha=8.0)}


def changed(settings, **changes):
    """The settings with more windows a step, and changes."""
    few = settings.optimizer.model_copy(update={"batch": 4, "warmup_steps": 1})
    return settings.model_copy(update={"optimizer": few, **changes}).with_adapters()


def in_bfloat16(settings):
    return settings.network.model_copy(
        update={"wan": settings.network.wan.model_copy(update={"precision": "bfloat16"})}
    )


@pytest.fixture
def episodes(large_episode):
    return [large_episode(seed) for seed in range(3)]


def gradients(run, batch, num_parts=1):
    generator = torch.Generator().manual_seed(3)
    examples = examples_of(run.model, batch, generator=generator, num_parts=num_parts)
    total = 0.0
    for part in examples.parts(num_parts):
        loss = errors(run.model, part, "float32")
        (loss.video + loss.tactile).backward()
        total += loss.video.item() + loss.tactile.item()
    return total, {name: one.grad for name, one in run.learned.items() if one.grad is not None}


@pytest.mark.parametrize(
    ("changes", "num_parts"),
    [
        ({"recompute": True}, 1),
        pytest.param({}, 2, marks=pytest.mark.long),
        pytest.param({"recompute": True, **LORA}, 4, marks=pytest.mark.long),
    ],
    ids=str,
)
def test_recomputed_activations_and_parts_of_batches_change_no_gradient(
    settings, episodes, changes, num_parts
):
    changes = changed(settings, **changes)
    plain = TrainingRun(episodes, changes.model_copy(update={"recompute": False}))
    batch = next(plain._batches())
    # Gradients of all adapters, which begin with an effect of zero.
    other = TrainingRun(episodes, changes)
    calls = []
    for run in (plain, other):
        for name, weight in run.learned.items():
            if is_adapter(name):
                nn.init.normal_(weight, 0.0, 0.1, torch.Generator().manual_seed(len(name)))
    ffn = other.model.layers[0].video.block.ffn
    ffn.register_forward_hook(lambda *_: calls.append(1))
    expected, expected_gradients = gradients(plain, batch)
    loss, found = gradients(other, batch, num_parts)
    assert len(calls) == num_parts * (2 if changes.recompute else 1)
    assert loss == pytest.approx(expected, rel=1e-6)
    assert found.keys() == expected_gradients.keys()
    for name, gradient in found.items():
        torch.testing.assert_close(
            gradient, expected_gradients[name], rtol=1e-5, atol=1e-6, msg=name
        )


def test_an_adapted_layer_is_that_of_the_paper_and_merges_into_its_weight():
    rng = np.random.default_rng(0)
    weight, bias, down, up, rows = (
        rng.normal(size=size) for size in ((5, 7), (5,), (3, 7), (5, 3), (4, 7))
    )
    base = nn.Linear(7, 5)
    layer = AdaptedLinear(base, 3, 8.0 / 3.0)
    before = layer(torch.from_numpy(rows).float())
    assert torch.equal(before, base(torch.from_numpy(rows).float()))
    state = {"weight": weight, "bias": bias, "lora_down": down, "lora_up": up}
    layer.load_state_dict({name: torch.from_numpy(one) for name, one in state.items()})
    # Hu et al. 2022, section 4.1: W x + (alpha / rank) B A x, with alpha = 8 and rank = 3.
    expected = rows @ weight.T + bias + 8 / 3 * (rows @ down.T) @ up.T
    given = torch.from_numpy(rows).float()
    np.testing.assert_allclose(layer(given).detach(), expected, rtol=1e-5, atol=1e-5)
    merged = nn.functional.linear(given, layer.merged_weight(), layer.bias)
    torch.testing.assert_close(merged, layer(given), rtol=1e-6, atol=1e-6 * 30)


@pytest.mark.long
@pytest.mark.parametrize("precision", ["float32", pytest.param("bfloat16", marks=pytest.mark.slow)])
def test_adapters_train_beside_frozen_weights_and_merge(settings, episodes, tmp_path, precision):
    network = in_bfloat16(settings) if precision == "bfloat16" else settings.network
    lora = changed(settings, network=network, **LORA)
    kept = lora.model_copy(
        update={
            "lora": LoraSettings(rank=4, alpha=8.0, keep=True),
            "output": tmp_path / "kept.safetensors",
        }
    )
    start = TrainingRun(episodes[:2], kept)
    initial = {name: one.clone() for name, one in start.model.state_dict().items()}
    for name, weight in start.model.named_parameters():
        assert weight.requires_grad == (is_adapter(name) or not is_pretrained(name)), name
    assert start.model.layers[0].video.block.attn1.to_q.weight.dtype == network.wan.dtype
    assert {weight.dtype for weight in start.learned.values()} == {torch.float32}
    assert start._averages.keys() == start.learned.keys()
    with_adapters = read_checkpoint(train_on(episodes[:2], episodes[2:], kept).checkpoint)
    assert with_adapters.metadata.network.adapters == (4, 2.0)
    for name, tensor in with_adapters.model.state_dict().items():
        is_frozen = is_pretrained(name) and not is_adapter(name)
        assert not is_frozen or torch.equal(tensor, initial[name]), name
    ups = [t for n, t in with_adapters.model.state_dict().items() if n.endswith("lora_up")]
    # Both attentions have four layers each, the feed-forward network two.
    assert len(ups) == 10 * network.num_layers
    assert sum(tensor.abs().max() > 0 for tensor in ups) >= len(ups) - 4
    merged = read_checkpoint(train_on(episodes[:2], episodes[2:], lora).checkpoint)
    assert merged.metadata.network == network
    assert not any(is_adapter(name) for name in merged.model.state_dict())
    batch = next(start._batches())

    def outputs(model):
        examples = examples_of(model, batch, generator=torch.Generator().manual_seed(0))
        with torch.no_grad():
            return model(examples.inputs, examples.first, examples.noisy, examples.t)

    ours, theirs = outputs(merged.model), outputs(with_adapters.model)
    # Merged weights are rounded to their precision.
    bound = 1e-6 if precision == "float32" else 5e-2
    torch.testing.assert_close(ours.video, theirs.video, rtol=bound, atol=bound)
    torch.testing.assert_close(ours.tactile, theirs.tactile, rtol=bound, atol=bound)
    # Either is a start of a run with other adapters, and those with the same go on.
    for checkpoint in (merged, with_adapters):
        run = TrainingRun(episodes[:2], kept.model_copy(update={"init": tmp_path}))
        run.start_from(checkpoint)
        torch.testing.assert_close(outputs(run.model).video, theirs.video, rtol=bound, atol=bound)


def test_frozen_video_trains_touch_and_actions_alone(settings, episodes):
    run = TrainingRun(episodes[:2], changed(settings, freeze_video=True))
    assert not any(is_pretrained(name) for name in run.learned)
    assert {name.split(".")[0] for name in run.learned} == {
        "video_condition", "tactile_condition", "tactile", "layers",
    }  # fmt: skip
    assert run._averages.keys() == run.learned.keys()
    before = {name: one.clone() for name, one in run.model.state_dict().items()}
    run.learn(next(run._batches()))
    moved = {n for n, one in run.model.state_dict().items() if not torch.equal(one, before[n])}
    assert moved <= run.learned.keys()
    assert moved & {name for name in run.learned if name.startswith("video_condition.actions")}


def test_averages_that_equal_the_weights_are_not_kept(settings, episodes):
    now = settings.optimizer.model_copy(update={"ema_decay": 0.0})
    run = TrainingRun(episodes[:2], settings.model_copy(update={"optimizer": now}))
    assert not run._averages
    assert run.whole_average() is run.model


class StoppedError(Exception):
    pass


def stop_after(run_settings, episodes, step, processes):
    """Train until a state after this step is there."""

    def stop(run):
        if run.budget.step == step:
            raise StoppedError

    kept = run_settings.model_copy(update={"state_every_s": 0.0, "resume": True})
    original = TrainingRun.run

    def run_until(run, progress, keep):
        return original(run, progress, lambda now: (keep(now), stop(now)))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrainingRun, "run", run_until)
        with pytest.raises(StoppedError):
            train_on(episodes[:2], episodes[2:], kept, processes=processes)
    return kept


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:FSDP2-wrapped module")
@pytest.mark.parametrize("is_sharded", [False, True])
def test_adapters_resume_from_states_without_frozen_weights(
    settings, episodes, tmp_path, sharded, is_sharded
):
    processes = sharded if is_sharded else Processes()
    lora = changed(settings, accumulate=2, recompute=True, max_steps=3, **LORA)
    expected = read_checkpoint(train_on(episodes[:2], episodes[2:], lora).checkpoint).model
    other = lora.model_copy(update={"output": tmp_path / "other.safetensors"})
    kept = stop_after(other, episodes, 2, processes)
    if not is_sharded:
        with safe_open(state_path(kept.output), framework="pt") as file:
            names = set(file.keys())
        assert not any(name.startswith("model.codec.") for name in names)
        assert {is_adapter(n) for n in names if ".video.block." in n} == {True}
    # They come from the folder again.
    nowhere = kept.wan.model_copy(update={"folder": None})
    with pytest.raises(InvalidInputError, match=r"--wan\.folder"):
        train_on(episodes[:2], episodes[2:], kept.model_copy(update={"wan": nowhere}))
    report = train_on(episodes[:2], episodes[2:], kept, processes=processes)
    assert report.steps == 3
    for name, tensor in read_checkpoint(report.checkpoint).model.state_dict().items():
        bounds = {"rtol": 1e-4, "atol": 1e-4} if is_sharded else {"rtol": 0, "atol": 0}
        torch.testing.assert_close(tensor, expected.state_dict()[name], **bounds, msg=name)


@pytest.mark.long
def test_a_run_that_time_ended_goes_on_with_more(settings, episodes, tmp_path):
    few = changed(settings, max_steps=4, freeze_video=True)
    expected = read_checkpoint(train_on(episodes[:2], episodes[2:], few).checkpoint).model
    cut = few.model_copy(
        update={"wall_budget_s": 1e-9, "resume": True, "output": tmp_path / "cut.safetensors"}
    )
    assert train_on(episodes[:2], episodes[2:], cut).steps == 1
    assert state_path(cut.output).is_file()
    # The limit counts in all: the same command would take no step.
    with pytest.raises(ConflictError, match=r"step 1 of 4 .*larger --wall-budget-s"):
        train_on(episodes[:2], episodes[2:], cut)
    more = cut.model_copy(update={"wall_budget_s": 1e9})
    report = train_on(episodes[:2], episodes[2:], more)
    assert report.steps == 4
    assert not state_path(cut.output).exists()
    # The learning rate followed the steps.
    for name, tensor in read_checkpoint(report.checkpoint).model.state_dict().items():
        assert torch.equal(tensor, expected.state_dict()[name]), name
    # Limits of steps are those of the run.
    kept = stop_after(few, episodes, 1, Processes())
    with pytest.raises(ConflictError, match="max_steps"):
        train_on(episodes[:2], episodes[2:], kept.model_copy(update={"max_steps": 9}))
    # A file of an earlier release had other names.
    tensors, notes = read_tensors(state_path(kept.output), "state")
    renamed = {name.replace("averaged.", "average."): one for name, one in tensors.items()}
    write_tensors(state_path(kept.output), renamed, notes)
    with pytest.raises(CorruptDataError, match=r"of another release .*start over"):
        train_on(episodes[:2], episodes[2:], kept)


def test_what_cannot_be_trained_is_refused(settings, episodes, train_settings, monkeypatch):
    for changes, flag in ((LORA, "--lora.rank 4"), ({"freeze_video": True}, "--freeze-video")):
        with pytest.raises(InvalidInputError, match=rf"{flag} .*--preset wan22-5b"):
            train_settings.model_copy(update=changes).with_adapters()
    with pytest.raises(InvalidInputError, match=r"4 windows.*--accumulate 3.* multiple of 3"):
        TrainingRun(episodes[:2], changed(settings, accumulate=3))
    with pytest.raises(InvalidInputError, match="torchrun"), joined_processes("cpu", 2):
        pass
    monkeypatch.setattr(distributed, "is_torchelastic_launched", lambda: True)
    with (
        pytest.raises(InvalidInputError, match=r"cuda:1 .*cpu or cuda"),
        joined_processes("cuda:1"),
    ):
        pass


def test_limits_of_a_run_are_steps_unless_time_is_asked_for(settings):
    free = settings.model_copy(update={"max_steps": None})
    assert free.step_limit == 10_000
    assert free.model_copy(update={"cpu_budget_s": 5.0}).step_limit is None
    assert settings.model_copy(update={"wall_budget_s": 5.0}).step_limit == settings.max_steps


@pytest.fixture
def eight_fake_processes():
    """The first of eight, which talks to nobody."""
    distributed.init_process_group("fake", store=FakeStore(), rank=0, world_size=8)
    yield distributed.device_mesh.init_device_mesh("cpu", (8,))
    distributed.destroy_process_group()


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:FSDP2-wrapped module")
def test_the_real_size_shards_over_eight_processes(eight_fake_processes):
    given = TrainCommand(preset="wan22-5b", episodes="unused", lora=LoraSettings(rank=16))
    wan = given.network.wan.model_copy(update={"precision": "bfloat16"})
    network = given.network.model_copy(update={"wan": wan}).adapted(16)
    with torch.device("meta"):
        model = JointWorldModel(network)
    freeze_pretrained(model)
    learned = sum(one.numel() for one in model.parameters() if one.requires_grad)
    sizes = {name: one.numel() for name, one in model.named_parameters()}
    assert sum(n for name, n in sizes.items() if ".video.block." in name) > 4.6e9
    # Ten layers of 3072 and 14336 in each of 30 blocks, and all of touch.
    adapters = sum(n for name, n in sizes.items() if is_adapter(name))
    assert adapters == 30 * 16 * (8 * 2 * 3072 + 2 * (3072 + 14336))
    assert learned == adapters + sum(n for name, n in sizes.items() if not is_pretrained(name)
                                     and not name.startswith("tokenizer."))  # fmt: skip
    processes = Processes(0, 8, eight_fake_processes)
    processes.shard(model, model.layers, whole=(model.codec, model.tokenizer))
    layers = {n: one for n, one in model.named_parameters() if n.startswith("layers.")}
    assert all(isinstance(one, DTensor) for one in layers.values())
    whole = {n: torch.empty(one.shape, dtype=one.dtype, device="meta") for n, one in layers.items()}
    # Rows that eight does not divide are in the first processes.
    assert memory_of(whole) / 8 <= memory_of(layers) <= memory_of(whole) / 8 * 1.01
