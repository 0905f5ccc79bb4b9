"""Routes of the rating page: blinded assignments, pictures, marks, keys."""

import io
import json

import httpx
import numpy as np
import pytest
from PIL import Image

from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError, UnknownNameError
from services.cli.main import main
from services.evaluation.rating.app import create_rating_app
from services.evaluation.rating.marks import Mark, MarkLog
from services.evaluation.rating.rating_queue import rated_rollouts, side_by_side
from services.evaluation.settings import RatingSettings
from tests.unit.evaluation import toy
from tests.unit.evaluation.toy_store import write

RUBRICS = """
[reach]
[[reach.criteria]]
name = "touched"
points = 2
milestone = "touched"
description = "The hand touched the spot."
[[reach.criteria]]
name = "stayed"
points = 1
description = "The hand stayed there."
latched = false
milestone = "stayed"
requires = ["touched"]
"""
KEY = {"name": "ada", "key": "a-key-of-some-length", "scopes": ("rate",)}
OTHER = {"name": "station", "key": "another-key-of-length", "scopes": ("station",)}


@pytest.fixture
def settings(tmp_path):
    store = EpisodeStore(str(tmp_path / "store"))
    for seed in (1, 2):
        item = toy.demonstration("reach", seed, name=f"imagined-dream-{seed}")
        write(store, item, origin="imagined")
    (tmp_path / "rubrics.toml").write_text(RUBRICS)
    return {
        "store_url": str(tmp_path / "store"),
        "marks": tmp_path / "ratings.sqlite",
        "rubrics": tmp_path / "rubrics.toml",
    }


def client(settings, **changes):
    app = create_rating_app(RatingSettings(**settings, **changes))
    transport = httpx.ASGITransport(app)
    return httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1")


def given(shown, **changes):
    return {
        "rater": "ada",
        "rollout": shown["rollout"],
        "presentation": shown["presentation"],
        "holds": {"touched": True, "stayed": False},
    } | changes


async def test_a_rater_rates_everything_without_learning_what_it_is(settings, tmp_path, capsys):
    async with client(settings) as http:
        for _ in range(2):
            answer = await http.get("/v1/rating/next", params={"rater": "ada"})
            assert "dream" not in answer.text
            assert "imagined" not in answer.text
            shown = answer.json()
            assert [one["name"] for one in shown["criteria"]] == ["touched", "stayed"]
            assert (shown["num_steps"], shown["rate_hz"]) == (toy.STEPS, 15.0)
            marked = await http.post("/v1/rating/marks", json=given(shown))
            assert marked.status_code == 201, marked.text
        done = await http.get("/v1/rating/next", params={"rater": "ada"})
        assert done.status_code == 204
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in settings.items()]
    path = tmp_path / "report.json"
    assert main(["rate", "report", *flags, "--json", str(path)]) == 0
    report = json.loads(path.read_text())
    assert [row["score"] for row in report["rollouts"]] == [pytest.approx(2 / 3)] * 2
    assert "reach: score 0.67 over 2 rollouts, 1 raters" in capsys.readouterr().out


def test_marks_by_another_rubric_are_refused_before_more_are_given(settings, capsys):
    holds = {"touched": True, "stayed": False}
    log, name = MarkLog(settings["marks"]), "imagined-dream-1"
    log.add(Mark(rater="ada", episode_id=name, holds=holds))
    log.add(Mark(rater="ada", episode_id="of-another-pool", holds={"other": True}))
    create_rating_app(RatingSettings(**settings))
    settings["rubrics"].write_text(RUBRICS.replace('"stayed"', '"rested"'))
    expected = "mark of 'ada' for 'imagined-dream-1': got the criteria touched, stayed, expected "
    with pytest.raises(InvalidInputError, match=f"{expected}touched, rested"):
        create_rating_app(RatingSettings(**settings))
    flags = [f"--{key.replace('_', '-')}={value}" for key, value in settings.items()]
    assert main(["rate", "report", *flags]) == 3
    message = capsys.readouterr().err
    assert expected in message
    assert "in another file (--marks)" in message
    # Whoever could not judge a rollout said nothing of any criterion.
    log.add(Mark(rater="ada", episode_id=name, cannot_judge=True))
    create_rating_app(RatingSettings(**settings))


@pytest.mark.parametrize("missing", ["store_url", "marks"])
def test_a_report_of_a_store_or_marks_that_are_not_there_is_refused(
    settings, tmp_path, capsys, missing
):
    MarkLog(settings["marks"])
    given = settings | {missing: tmp_path / "missing"}
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in given.items()]
    assert main(["rate", "report", *flags]) == 3
    assert "missing: no such" in capsys.readouterr().err
    assert not given[missing].exists()


async def test_the_report_compares_people_with_the_twin(settings, tmp_path):
    store = EpisodeStore(settings["store_url"])
    noted = toy.demonstration("reach", 3, name="noted")
    write(store, noted, origin="twin", event_times_s={"touched": 1.0, "stayed": 3.0})
    write(store, toy.demonstration("reach", 4, name="missed"), origin="twin", success=False)
    write(store, toy.demonstration("reach", 5, name="unknown"), origin="twin", success=True)
    async with client(settings) as http:
        while (shown := await http.get("/v1/rating/next", params={"rater": "ada"})).is_success:
            if shown.status_code == 204:
                break
            await http.post("/v1/rating/marks", json=given(shown.json(), kind="human"))
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in settings.items()]
    path = tmp_path / "report.json"
    assert main(["rate", "report", *flags, "--json", str(path)]) == 0
    report = json.loads(path.read_text())
    true = {row["episode_id"]: row["state_score"] for row in report["rollouts"]}
    assert {name: true[name] for name in ("noted", "missed", "unknown")} == {
        "noted": 1.0,
        "missed": 0.0,
        "unknown": "undefined",
    }
    # Ada gave two points of three to both: one third too few, two thirds too many.
    assert report["tasks"]["reach"]["less_state_score"] == pytest.approx((2 / 3 - 1 + 2 / 3) / 2)


def entry(study):
    return {"kind": "rollout", "id": f"{study}: hold in real"}


def queued(settings, **changes):
    """Ids of the episodes that are rated."""
    store, study = EpisodeStore(settings["store_url"]), changes.get("study")
    return {one.episode_id for one in rated_rollouts(store, ("reach",), study=study)}


@pytest.mark.parametrize(
    "about",
    [
        {"origin": "recorded", "operator": "op-1"},
        {"origin": "recorded", "domain": "human"},
        {"origin": "recorded", "station": "desk_1"},
        {"origin": "twin", "operator": "op-1"},
    ],
)
def test_takes_of_operators_are_never_rated(settings, about):
    store = EpisodeStore(settings["store_url"])
    write(store, toy.demonstration("reach", 3, name="a-take"), **about)
    assert queued(settings) == {"imagined-dream-1", "imagined-dream-2"}


def test_a_rollout_of_a_real_robot_is_rated(settings):
    store = EpisodeStore(settings["store_url"])
    write(
        store,
        toy.demonstration("reach", 3, name="real"),
        origin="recorded",
        lineage=[entry("Shoes")],
    )
    assert "real" in queued(settings)


def test_one_studys_rollouts_are_rated_when_asked(settings):
    store = EpisodeStore(settings["store_url"])
    for seed, study in ((3, "shoes"), (4, "shoes_2")):
        item = toy.demonstration("reach", seed, name=f"of-{study}")
        write(store, item, lineage=[entry(study)])
    assert queued(settings, study="shoes") == {"of-shoes"}
    with pytest.raises(InvalidInputError, match="'cups'"):
        create_rating_app(RatingSettings(**settings, study="cups"))


async def test_a_program_is_a_rater_of_its_own_kind(settings):
    async with client(settings) as http:
        shown = (await http.get("/v1/rating/next", params={"rater": "probe"})).json()
        answer = await http.post("/v1/rating/marks", json=given(shown, rater="probe", kind="auto"))
        assert answer.status_code == 201
        (stored,) = MarkLog(settings["marks"]).history()
        assert (stored.mark.rater, stored.mark.kind) == ("probe", "auto")
        assert (await http.get("/v1/rating/next", params={"rater": "ada"})).json()["num_open"] == 2


async def test_pictures_show_image_and_touch(settings):
    async with client(settings) as http:
        shown = (await http.get("/v1/rating/next", params={"rater": "ada"})).json()
        place = f"/v1/rating/rollouts/{shown['rollout']}/steps"
        pictures = [
            np.asarray(Image.open(io.BytesIO((await http.get(f"{place}/{step}.jpg")).content)))
            for step in (0, toy.STEPS - 1)
        ]
        assert pictures[0].shape == pictures[1].shape
        assert (pictures[0] != pictures[1]).any()
        assert (await http.get(f"{place}/{toy.STEPS}.jpg")).status_code == 404
        assert (await http.get(f"/v1/rating/rollouts/{'0' * 20}/steps/0.jpg")).status_code == 404


def test_touch_is_drawn_beside_the_image():
    red = np.zeros((48, 64, 3), dtype=np.uint8)
    red[..., 0] = 200
    pressed = np.zeros((2, 320), dtype=np.float32)
    pressed[1] = 50.0
    shown, still = (side_by_side(red, kpa) for kpa in (pressed, 0 * pressed))
    width = 64 * 384 // 48
    assert (shown[:, :width] == [200, 0, 0]).all()
    changed = np.flatnonzero((shown != still).any(axis=(0, 2)))
    # Only the right hand, on the right of its map, has changed.
    assert changed.min() > width + 8 + (shown.shape[1] - width - 8) / 2


@pytest.mark.parametrize(
    ("changes", "status", "says"),
    [
        ({"holds": {"touched": True}}, 422, "no mark for stayed"),
        ({"holds": {"touched": True, "stayed": True, "flew": True}}, 422, "flew"),
        ({"holds": {}}, 422, "cannot_judge"),
        ({"rater": "a b"}, 422, "rater"),
        ({"rollout": "0" * 20}, 404, "rollout"),
        ({"comment": "x" * 2001}, 422, "comment"),
    ],
)
async def test_marks_that_do_not_fit_change_nothing(settings, changes, status, says):
    async with client(settings) as http:
        shown = (await http.get("/v1/rating/next", params={"rater": "ada"})).json()
        answer = await http.post("/v1/rating/marks", json=given(shown, **changes))
        assert answer.status_code == status, answer.text
        assert says in answer.text
        again = (await http.get("/v1/rating/next", params={"rater": "ada"})).json()
        assert again == shown


async def test_with_keys_nobody_marks_for_another(settings):
    async with client(settings, api_keys=(KEY, OTHER)) as http:
        assert (await http.get("/")).status_code == 200
        assert (await http.get("/v1/rating/next", params={"rater": "ada"})).status_code == 401
        for key, status in ((OTHER, 403), (KEY, 200)):
            headers = {"authorization": f"Bearer {key['key']}"}
            answer = await http.get("/v1/rating/next", params={"rater": "ada"}, headers=headers)
            assert answer.status_code == status
        forged = given(answer.json(), rater="bob")
        refused = await http.post("/v1/rating/marks", json=forged, headers=headers)
        assert refused.status_code == 409
        assert "'ada', the name of this key" in refused.text


async def test_a_foreign_page_cannot_mark(settings):
    async with client(settings) as http:
        shown = (await http.get("/v1/rating/next", params={"rater": "ada"})).json()
        headers = {"origin": "https://elsewhere.example"}
        answer = await http.post("/v1/rating/marks", json=given(shown), headers=headers)
        assert answer.status_code == 403


def test_nothing_to_rate_is_an_error(settings):
    with pytest.raises(UnknownNameError, match="juggle"):
        create_rating_app(RatingSettings(**settings, tasks=("juggle",)))
    with pytest.raises(InvalidInputError, match="has no episode"):
        create_rating_app(RatingSettings(**settings | {"rubrics": None}))
