"""Windows and samples over HTTP: media type, tags that spare the answer, bounds with numbers."""

import numpy as np
import pytest
from httpx import ASGITransport, AsyncClient

from dextouch.episodes import EpisodeStore, ImageForm, decode_window
from dextouch.streams import unpack
from services.episode_store import reading as reading_module
from services.episode_store.app import create_app
from services.episode_store.reading import is_known
from tests.unit.episode_store.episodes import write_episode

WINDOW = "/v1/episodes/e-1/windows?start=2&num_steps=5"


@pytest.fixture
def store(settings):
    ours = EpisodeStore(settings.store_url)
    write_episode(ours, "e-1")
    return ours


@pytest.fixture
def http(settings):
    return AsyncClient(transport=ASGITransport(create_app(settings)), base_url="http://localhost")


@pytest.mark.parametrize("accept", [None, "*/*", "application/json"])
async def test_windows_have_a_media_type_of_their_own(http, store, accept):
    response = await http.get(WINDOW, headers={"accept": accept} if accept else {})
    assert response.status_code == 200
    assert response.headers["content-type"] == "application/vnd.dextouch.window+msgpack"
    window = decode_window(response.content, max_bytes=10**6)
    np.testing.assert_array_equal(window.actions, store.open("e-1").window(2, 5).actions)


@pytest.mark.parametrize("path", [WINDOW, "/v1/episodes/e-1/streams/camera_head?stop_ns=200000000"])
async def test_who_has_the_answer_is_told_so(http, store, path, monkeypatch):
    first = await http.get(path)
    tag = first.headers["etag"]
    other = await http.get(path.replace("2", "1"))
    assert other.headers["etag"] != tag
    with monkeypatch.context() as patch:
        # Nothing is decoded for an answer that is not sent.
        patch.setattr(reading_module.episodes, "encode_window", None)
        patch.setattr(reading_module, "pack", None)
        for known in (tag, f'"x", W/{tag}', "*"):
            response = await http.get(path, headers={"if-none-match": known})
            assert (response.status_code, response.content) == (304, b"")
            assert response.headers["etag"] == tag
    assert (await http.get(path, headers={"if-none-match": '"x"'})).content == first.content
    store.delete("e-1")
    assert (await http.get(path, headers={"if-none-match": tag})).status_code == 404
    write_episode(store, "e-1", instruction="another one")
    response = await http.get(path, headers={"if-none-match": tag})
    assert response.status_code == 200
    assert response.headers["etag"] != tag


def test_tags_are_compared_whole():
    assert not is_known('"abc"', None)
    assert not is_known('"abc"', '"ab", "abcd", abc')


async def test_no_camera_half_size_and_gray(http, store):
    bare = decode_window((await http.get(WINDOW + "&cameras=")).content, max_bytes=10**6)
    assert bare.images == {}
    reader = store.open("e-1")
    half = decode_window((await http.get(WINDOW + "&half_size=true")).content, max_bytes=10**6)
    expected = reader.window(2, 5, form=ImageForm(half_size=True)).images["camera_head"]
    assert expected.shape == (5, 16, 16, 3)
    np.testing.assert_array_equal(half.images["camera_head"], expected)
    gray = unpack((await http.get(WINDOW + "&gray=true")).content, max_bytes=10**6)[1]
    expected = reader.window(2, 5, form=ImageForm(gray=True)).images["camera_head"]
    np.testing.assert_array_equal(gray["images/camera_head"], expected)


async def test_refusals_name_the_allowed_number(settings, store):
    app = create_app(
        settings.model_copy(update={"max_answer_bytes": 20_000, "max_window_steps": 8})
    )
    async with AsyncClient(transport=ASGITransport(app), base_url="http://localhost") as http:
        for path, allowed in (
            ("/v1/episodes/e-1/windows?start=0&num_steps=9", 8),
            ("/v1/episodes/e-1/windows?start=0&num_steps=8", 20_000 // (32 * 32 * 3)),
            ("/v1/episodes/e-1/streams/camera_head", 20_000 // (32 * 32 * 3 + 24)),
        ):
            problem = (await http.get(path)).json()
            assert (problem["status"], problem["details"]["expected"]) == (413, allowed)
        for path in (
            f"/v1/episodes/e-1/windows?start=0&num_steps={20_000 // (32 * 32 * 3)}",
            "/v1/episodes/e-1/windows?start=0&num_steps=8&half_size=true",
        ):
            assert (await http.get(path)).status_code == 200
        assert (await http.get(WINDOW + "&colour=no")).status_code == 422
