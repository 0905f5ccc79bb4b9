"""Imagined episodes: what a world showed, with the outcome and the lineage of their source."""

import numpy as np
import pytest

from dextouch.clients.rollouts import RolloutClient
from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError
from dextouch.worlds.baseline import CopyFirstWorld
from dextouch.worlds.serve import WorldServiceSettings, create_world_app
from services.cli.demo.background import served
from services.generation.demonstrations import imagine_episode
from services.twin.episodes import demonstrate, write_episode


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    store = EpisodeStore(tmp_path_factory.mktemp("truth"))
    ids = [
        write_episode(store, demonstrate("stack_bowls", 3, domain=domain, images=("camera_head",)))
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


def test_an_episode_without_commands_is_refused(sources, client, tmp_path):
    with pytest.raises(InvalidInputError, match="commanded"):
        imagine_episode(sources[1], client, "copy-first", EpisodeStore(tmp_path))
