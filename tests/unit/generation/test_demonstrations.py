"""Imagined episodes: what a world showed, with the outcome and the lineage of their source."""

from dataclasses import replace

import numpy as np
import pytest

from dextouch.clients import RolloutClient
from dextouch.episodes import EpisodeGrid, EpisodeStore, check_id
from dextouch.errors import InvalidInputError
from dextouch.images import scaled_square
from dextouch.schemas import EVERYTHING, Uncertainty
from dextouch.worlds import CopyFirstWorld, SteppedRollout, WorldServiceSettings, create_world_app
from services.evaluation.endings import read_ending_episode
from services.generation import imagine_episode, imagined_id
from services.pipelines.servers import served
from services.twin.episodes import record, write_episode
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.take_options import TakeOptions
from tests.unit.evaluation import toy, toy_store


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    store = EpisodeStore(tmp_path_factory.mktemp("truth"))
    head = TakeOptions(images=("camera_head",))
    ids = [
        write_episode(store, record(Stage("stack_bowls", domain, TwinSettings()), 3, head))
        for domain in ("robot", "human")
    ]
    return [store.open(name) for name in ids]


@pytest.fixture(scope="module")
def client():
    app = create_world_app(
        {"copy-first": CopyFirstWorld(tasks=("stack_bowls",))}, WorldServiceSettings()
    )
    with served({"worlds": app}) as urls, RolloutClient(urls["worlds"]) as client:
        yield client


def test_a_long_id_of_a_source_is_cut_and_stays_its_own():
    assert imagined_id("take-1", "0123456789ab") == "imagined-01234567-take-1"
    # Of 110 letters and more, with the world's 18; ids have at most 128.
    one, other = (imagined_id("t" * 120 + last, "0123456789ab") for last in "ab")
    assert check_id(one) != check_id(other)
    assert len(check_id(imagined_id("t" * 110, "0123456789ab"))) == 128


@pytest.mark.long
def test_an_imagined_episode_shows_what_the_world_showed(sources, client, tmp_path):
    source, store = sources[0], EpisodeStore(tmp_path)
    name = imagine_episode(source, client, "copy-first", store)
    assert imagine_episode(source, client, "copy-first", store) == name
    imagined = store.open(name)
    attributes = imagined.attributes
    assert attributes.origin == "imagined"
    assert attributes.success == source.attributes.success
    assert attributes.lineage[-2].sha256 == source.content_sha256
    window = imagined.window(0, imagined.num_steps, action_kind="commanded")
    truth = source.window(0, source.num_steps, action_kind="commanded")
    np.testing.assert_array_equal(
        window.images["camera_head"], np.repeat(truth.images["camera_head"][:1], 81, axis=0)
    )
    np.testing.assert_array_equal(window.tactile_kpa[40], truth.tactile_kpa[0])
    np.testing.assert_allclose(window.actions, truth.actions, atol=1e-9)


def test_the_lens_and_refused_taxels_of_a_source_are_not_those_of_the_world(client, tmp_path):
    spans = ((1.0, 2.0),)
    calibration = {
        "distortion_head": ((-0.3, 0.1, 0.0, 0.0, 0.0),), "interpolated_wrist_left_s": spans,
        "tactile_left_refused_taxels": ((1.0,) * 100 + (0.0,) * 220,),
    }  # fmt: skip
    take = replace(toy.demonstration("reach", 3), task="stack_bowls")
    take = replace(take, images=take.images.repeat(2, axis=1).repeat(2, axis=2))
    store = EpisodeStore(tmp_path)
    toy_store.write(store, take, calibration=calibration)
    source = EpisodeGrid(store.open(take.episode_id))
    imagined = EpisodeGrid(store.open(imagine_episode(source.reader, client, "copy-first", store)))
    np.testing.assert_array_equal(imagined.images([0]), source.images([0]))
    assert imagined.measured_taxels.all()
    assert imagined.about.calibration == {"interpolated_wrist_left_s": spans}


def test_an_episode_of_another_rate_is_refused(sources, tmp_path):
    fast = CopyFirstWorld(tasks=("stack_bowls",), model_rate_hz=30.0)
    app = create_world_app({"fast": fast}, WorldServiceSettings())
    with (
        served({"worlds": app}) as urls,
        RolloutClient(urls["worlds"]) as client,
        pytest.raises(InvalidInputError, match="at 15 steps a second, expected 30"),
    ):
        imagine_episode(sources[0], client, "fast", EpisodeStore(tmp_path))


class _PoseWorld(CopyFirstWorld):
    """Repeats the first image, and says that one bowl rises by a millimetre a step.

    It calls its second chunk unreliable; success becomes likelier from step to step.
    """

    @property
    def description(self):
        names = {"stack_bowls": ("bowl_a", "bowl_b")}
        return super().description.model_copy(update={"object_names": names})

    def step(self, state, actions, *, seed, selector=EVERYTHING):
        stepped = super().step(state, actions, seed=seed)
        steps = state.first_step + 1 + np.arange(len(actions))
        poses = np.zeros((len(actions), 2, 7), np.float32)
        poses[:, :, 3], poses[:, 1, 2] = 1.0, 0.001 * steps
        uncertainty = Uncertainty(
            disagreement=0, distance=0,
            outside=steps[0] == 17, reason="slipped" if steps[0] == 17 else None,
            success_probability=float(steps[-1]) / 100, success_spread=0.5,
        )  # fmt: skip
        seen = replace(stepped.observation, object_poses=poses, uncertainty=uncertainty)
        return SteppedRollout(stepped.state, seen.selected(selector))


def test_imagined_poses_are_kept_for_the_judge(sources, tmp_path):
    app = create_world_app({"poses": _PoseWorld(tasks=("stack_bowls",))}, WorldServiceSettings())
    store = EpisodeStore(tmp_path)
    with served({"worlds": app}) as urls, RolloutClient(urls["worlds"]) as client:
        name = imagine_episode(sources[0], client, "poses", store)
    reader = store.open(name)
    kept = reader.read("object_poses")
    assert len(kept) == reader.num_steps - 1
    ending = read_ending_episode(reader).final
    assert ending.imagined
    np.testing.assert_allclose(ending.object_poses[:, 1, 2], [0.078, 0.079, 0.080], atol=1e-6)
    quality = reader.attributes.quality
    assert quality["imagined_doubted_step"] == 32
    assert (quality["imagined_success_probability"], quality["imagined_success_spread"]) == (
        0.8,
        0.5,
    )
    assert sources[0].attributes.quality.items() <= quality.items()
    assert ending.success_probability == 0.8
    assert ending.unreliable == "at step 32, the world called its prediction unreliable"
    # Only the end is what these figures are about.
    endings = read_ending_episode(reader).endings
    assert {one.success_probability for step, one in endings.items() if step != 80} == {None}


def test_endings_of_a_true_episode_are_those_of_the_twin(sources):
    source = sources[0]
    episode = read_ending_episode(source)
    assert not episode.final.imagined
    assert episode.event_times_s == source.attributes.event_times_s
    assert episode.success == source.attributes.success
    window = source.window(78, 3)
    np.testing.assert_array_equal(episode.final.images, window.images["camera_head"])
    np.testing.assert_array_equal(episode.final.tactile_kpa, window.tactile_kpa)
    # The twin notes poses 100 times a second: the last ones are those of the last step.
    truth = source.read("object_poses").values[-1]
    np.testing.assert_allclose(episode.final.object_poses[-1], truth, atol=1e-6)


def test_an_episode_without_commands_replays_what_was_reached(sources, client, tmp_path):
    source = sources[1]
    assert "action_commanded" not in source.streams
    imagined = EpisodeStore(tmp_path).open(
        imagine_episode(source, client, "copy-first", EpisodeStore(tmp_path))
    )
    replayed = imagined.read("action_commanded").values
    np.testing.assert_allclose(replayed, source.read("action").values, atol=1e-9)


class _SmallWorld(CopyFirstWorld):
    """Sees half of every side of its first image."""

    @property
    def description(self):
        small = {"image_height_px": 32, "image_width_px": 32, "scales_images": True}
        return super().description.model_copy(update=small)

    def reset(self, start):
        seen = start.observation
        images, K_head = scaled_square(seen.images["camera_head"], start.K_head, 32)
        small = replace(seen, images={"camera_head": images})
        return super().reset(replace(start, observation=small, K_head=K_head))


def test_images_and_camera_are_those_that_the_world_shows(sources, tmp_path):
    app = create_world_app({"small": _SmallWorld(tasks=("stack_bowls",))}, WorldServiceSettings())
    store = EpisodeStore(tmp_path)
    with served({"worlds": app}) as urls, RolloutClient(urls["worlds"]) as client:
        imagined = store.open(imagine_episode(sources[0], client, "small", store))
    window = imagined.window(0, imagined.num_steps)
    assert window.images["camera_head"].shape == (81, 32, 32, 3)
    expected = scaled_square(np.zeros((1, 64, 64, 3), np.uint8), sources[0].window(0).K_head, 32)
    np.testing.assert_allclose(window.K_head, expected[1])


class _Coarse(CopyFirstWorld):
    """Takes chunks of eight steps."""

    @property
    def description(self):
        return super().description.model_copy(update={"chunk_multiple": 8, "max_chunk_steps": 16})


@pytest.mark.long
def test_what_is_left_over_of_a_chunk_is_cut_off(tmp_path):
    stage = Stage("stack_bowls", "robot", TwinSettings())
    truth = record(stage, 3, TakeOptions(images=("camera_head",), streams="training"))
    short = {
        name: replace(stream, t_ref_ns=stream.t_ref_ns[kept], values=stream.values[kept])
        for name, stream in truth.streams.items()
        for kept in [stream.t_ref_ns <= round(70e9 / 15)]
    }
    source = EpisodeStore(tmp_path / "true")
    write_episode(source, replace(truth, streams=short))
    (name,) = source.list()
    assert source.open(name).num_steps == 71
    app = create_world_app({"coarse": _Coarse(tasks=("stack_bowls",))}, WorldServiceSettings())
    target = EpisodeStore(tmp_path / "imagined")
    with served({"worlds": app}) as urls, RolloutClient(urls["worlds"]) as client:
        imagined = target.open(imagine_episode(source.open(name), client, "coarse", target))
    assert imagined.num_steps == 65
