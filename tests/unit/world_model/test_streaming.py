"""Windows read from the disk are those cut in memory, in the same order, in any process."""

import json
import multiprocessing
from itertools import islice

import numpy as np
import pytest
import torch

from dextouch.episodes import EpisodeReader, EpisodeStore
from dextouch.errors import InvalidInputError, NotFoundError
from services.world_model.checkpoints import read_checkpoint
from services.world_model.command_line import run_train
from services.world_model.training.episode_sets import load_split
from services.world_model.training.joint_dataset import (
    WindowPosition,
    WindowSampler,
    index_episodes,
    load_episodes,
    read_batches,
    read_episode,
)
from services.world_model.training.joint_trainer import TrainingRun, train
from tests.unit.world_model.conftest import write_episode

PLACES = [
    WindowPosition(0, 0, 17),
    WindowPosition(2, 7, 9, action_kind="commanded"),
    WindowPosition(2, 24, 17, action_kind="commanded", from_command=True),
    WindowPosition(5, 36, 5),
]


@pytest.fixture
def url(toy_store):
    return str(toy_store.root)


@pytest.fixture
def stored(url):
    return index_episodes(url)


@pytest.fixture
def in_memory(url):
    return load_episodes(url)


def assert_same_window(got, expected):
    np.testing.assert_array_equal(got.images, expected.images)
    np.testing.assert_array_equal(got.tactile_kpa, expected.tactile_kpa)
    np.testing.assert_array_equal(got.tactile_valid, expected.tactile_valid)
    ours, theirs = got.request, expected.request
    np.testing.assert_array_equal(ours.first_image, theirs.first_image)
    np.testing.assert_array_equal(ours.first_tactile_kpa, theirs.first_tactile_kpa)
    np.testing.assert_array_equal(ours.objects.poses, theirs.objects.poses)
    np.testing.assert_array_equal(ours.objects.boxes_m, theirs.objects.boxes_m)
    # Re-anchored once here and twice there.
    np.testing.assert_allclose(ours.actions, theirs.actions, atol=1e-12)
    for a, b in zip(ours.anchor.as_tuple(), theirs.anchor.as_tuple(), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)
    np.testing.assert_array_equal(ours.K_head, theirs.K_head)
    assert (ours.action_kind, ours.instruction) == (theirs.action_kind, theirs.instruction)


def assert_same_batch(got, expected):
    assert torch.equal(got.images, expected.images)
    assert torch.equal(got.tactile_kpa, expected.tactile_kpa)
    assert torch.equal(got.tactile_valid, expected.tactile_valid)
    for ours, theirs in zip(got.requests, expected.requests, strict=True):
        np.testing.assert_allclose(ours.actions, theirs.actions, atol=1e-12)
        assert ours.action_kind == theirs.action_kind


@pytest.mark.parametrize("place", PLACES)
def test_a_streamed_window_is_the_one_cut_in_memory(stored, in_memory, place):
    index = place.episode_index
    assert_same_window(stored[index].cut(place), in_memory[index].cut(place))


def test_an_indexed_episode_says_what_it_is(stored, in_memory):
    for ours, theirs in zip(stored, in_memory, strict=True):
        assert (ours.episode_id, ours.task, ours.scene) == (
            theirs.episode_id, theirs.task, theirs.scene,
        )  # fmt: skip
        assert len(ours) == len(theirs)
        assert set(ours.action_kinds) == {"measured", "commanded"}
        assert ours.fingerprint() == theirs.fingerprint()
        assert ours.load().fingerprint() == ours.fingerprint()


@pytest.fixture
def start_method(request):
    before = multiprocessing.get_start_method()
    multiprocessing.set_start_method(request.param, force=True)
    yield
    multiprocessing.set_start_method(before, force=True)


@pytest.mark.parametrize(
    ("num_workers", "start_method"),
    [(0, "fork"), (2, "fork"), (1, "spawn")],
    indirect=["start_method"],
)
@pytest.mark.usefixtures("start_method")
@pytest.mark.slow
def test_batches_are_the_same_in_any_process(stored, in_memory, num_workers):
    def sampler(episodes):
        return WindowSampler(episodes, np.random.default_rng(3), max_steps=17)

    lengths = (17, 9, 5, 17)
    memory, streamed = sampler(in_memory), sampler(stored)
    expected = [memory.draw(4, n) for n in lengths]
    places = [streamed.places(4, n) for n in lengths]
    got = read_batches(stored, places, num_workers=num_workers)
    for ours, theirs in zip(got, expected, strict=True):
        assert_same_batch(ours, theirs)


def test_batches_of_endless_places_end_with_their_reader(stored):
    sampler = WindowSampler(stored, np.random.default_rng(0), max_steps=17)
    batches = read_batches(stored, iter(lambda: sampler.places(2, 5), None), num_workers=1)
    assert [len(batch.requests) for batch in islice(batches, 3)] == [2, 2, 2]
    batches.close()
    assert torch.multiprocessing.active_children() == []


def test_reading_ahead_leaves_the_global_random_numbers_alone(stored):
    torch.manual_seed(5)
    before = torch.random.get_rng_state()
    list(read_batches(stored, [PLACES[:1]]))
    assert torch.equal(torch.random.get_rng_state(), before)


def test_only_the_models_camera_is_decoded(stored, monkeypatch):
    decoded = []
    images_at = EpisodeReader.images_at

    def noted(self, name, indices, **options):
        decoded.append((name, indices.tolist()))
        return images_at(self, name, indices, **options)

    monkeypatch.setattr(EpisodeReader, "images_at", noted)
    stored[0].cut(WindowPosition(0, 7, 5))
    assert decoded == [("camera_head", [7, 8, 9, 10, 11])]


def test_steps_that_do_not_exist_are_refused(stored):
    with pytest.raises(InvalidInputError, match="steps 30"):
        stored[0].cut(WindowPosition(0, 30, 17))


def test_images_of_every_second_step_are_not_taken_for_those_of_all(tmp_path, toy_episode):
    store = EpisodeStore(tmp_path / "sparse")
    write_episode(store, toy_episode(0), image_every=2)
    for read in (index_episodes, load_episodes):
        with pytest.raises(NotFoundError, match=r"1 without an image of nearly .*--images 1"):
            read(str(store.root))
    with pytest.raises(InvalidInputError, match=r"toy-0.*: 20 of 41 steps .*--images 1"):
        read_episode(store.open("toy-0"))


@pytest.mark.slow
def test_streamed_training_gives_the_weights_of_training_in_memory(
    stored, in_memory, train_settings
):
    def weights(episodes, **changes):
        settings = train_settings.model_copy(update={"max_steps": 6, **changes})
        run = TrainingRun(episodes, settings)
        run.fit_codecs()
        run.run()
        return run.whole_average().state_dict()

    expected = weights(in_memory)
    for workers in (0, 1):
        got = weights(stored, streaming=True, loader_workers=workers)
        for name, weight in expected.items():
            torch.testing.assert_close(got[name], weight, rtol=1e-4, atol=1e-6, msg=name)


@pytest.mark.long
def test_streaming_splits_and_reports_as_training_in_memory(toy_store, train_settings):
    settings = train_settings.model_copy(
        update={"heldout_percent": 50, "max_steps": 2, "streaming": True, "loader_workers": 0}
    )
    trained, heldout = load_split(settings)
    plain = load_split(settings.model_copy(update={"streaming": False}))
    assert [e.episode_id for e in trained] == [e.episode_id for e in plain[0]]
    assert [e.episode_id for e in heldout] == [e.episode_id for e in plain[1]]
    metadata = read_checkpoint(train(settings).checkpoint).metadata
    assert metadata.train_fingerprints == tuple(sorted(e.fingerprint() for e in plain[0]))
    given = settings.model_copy(update={"heldout": settings.episodes})
    with pytest.raises(InvalidInputError, match="also trained on"):
        train(given)


@pytest.mark.long
def test_the_command_line_streams(toy_store, tmp_path, capsys):
    output, report = tmp_path / "m.safetensors", tmp_path / "report.json"
    flags = {
        "episodes": toy_store.root, "output": output, "json": report, "max_steps": 2,
        "heldout_percent": 50, "network.image_px": 32, "network.video_width": 16,
        "network.tactile_width": 16, "network.num_layers": 1, "network.num_heads": 1,
        "network.codec_channels": 8, "windows.fit_windows": 8, "optimizer.batch": 2,
        "loader_workers": 0,
    }  # fmt: skip
    arguments = [f"--{name.replace('_', '-')}={value}" for name, value in flags.items()]
    assert run_train(["--preset=tiny", "--streaming", *arguments]) == 0
    assert json.loads(report.read_text())["steps"] == 2
    command = read_checkpoint(output).metadata.command
    assert command.startswith("dextouch train world-model --")
    assert " --streaming " in command
    assert " --network.image-px=32" in command
    capsys.readouterr()


def test_larger_images_are_scaled_in_memory_and_from_disk_alike(url, in_memory):
    """A camera of a station has more pixels than a network's image."""
    large = in_memory[0]
    side = large.images.shape[1] // 2
    loaded = load_episodes(url, image_px=side)[0]
    stored = index_episodes(url, image_px=side)[0]
    assert loaded.images.shape == (len(large), side, side, 3)
    assert loaded.fingerprint() == stored.fingerprint() != large.fingerprint()
    np.testing.assert_allclose(loaded.K_head[:2], large.K_head[:2] / 2)
    place = WindowPosition(0, 3, 5)
    from_disk, cut = stored.cut(place), loaded.cut(place)
    np.testing.assert_array_equal(from_disk.images, cut.images)
    np.testing.assert_array_equal(from_disk.request.K_head, cut.request.K_head)
