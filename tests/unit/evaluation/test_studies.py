"""Studies: their definition, results that survive a kill, and rollouts that are kept."""

import json
from contextlib import ExitStack
from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from dextouch.clients import PolicyStart, RolloutClient, http_link
from dextouch.episodes import EpisodeStore
from dextouch.errors import ConflictError, InvalidInputError, UnavailableError
from dextouch.schemas import Uncertainty
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.evaluation.closed_loop import EvaluationPlan, begin_matched, evaluate
from services.evaluation.endings import read_ending_episode
from services.evaluation.matched_starts import StudyWorlds, WorldAddress
from services.evaluation.policies.colour_servo import ColourServo
from services.evaluation.policies.open_loop import HoldPolicy
from services.evaluation.rating.rating_queue import rated_rollouts, state_scores
from services.evaluation.rating.rubrics import Rubric
from services.evaluation.scores import ClosedLoopReport, RolloutFailure, RolloutScore
from services.evaluation.studies.engine import PolicyFactory, StudyParts, run_study
from services.evaluation.studies.results import (
    PlannedRollout,
    StudyDefinition,
    StudyHeader,
    StudyResults,
    planned_rollouts_of,
    read_definition,
    rollout_episode_id,
    study_report,
)
from services.evaluation.studies.study_figures import kept_pairs, write_reports
from services.evaluation.success_classifier import SuccessClassifier
from services.evaluation.trained_networks import save_checkpoint
from tests.unit.evaluation import toy, toy_store
from tests.unit.worlds.running import served

pytestmark = pytest.mark.long

STUDY = """
name = "toy"
tasks = ["reach", "reach far"]
first_seed = 2000
num_starts = 3
in_flight = 2

[real]
url = "http://127.0.0.1:1"
world = "judge"

[imagined.dream]
url = "http://127.0.0.1:1"
world = "dream"

[policies.hold]
builtin = "hold"
[policies.script]
factory = "toys:script"
"""


def definition_of(text, folder, **changed):
    (folder / "study.toml").write_text(text)
    return read_definition(folder / "study.toml").model_copy(update=changed)


def test_a_study_counts_its_rollouts(tmp_path):
    study = definition_of(STUDY, tmp_path, repeats=2)
    # 2 tasks x 3 starts x 2 policies: once in the real world, twice in the other.
    assert study.num_rollouts == 12 * 3 == len(set(planned_rollouts_of(study)))
    assert next(planned_rollouts_of(study)) == PlannedRollout("real", "reach", 2000, "hold", 0)
    assert study.digest != definition_of(STUDY, tmp_path).digest
    assert study.digest == study.model_copy(update={"name": "another"}).digest
    again = StudyDefinition.model_validate_json(study.model_dump_json())
    assert again == study


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("num_starts = 3", "num_starts = 0", "num_starts"),
        ("num_starts = 3", "num_starts = 3000", "at most 2000"),
        ("num_starts = 3", "number = 3", "number"),
        ('world = "dream"', "", "`world` names a world"),
        ('url = "http://127.0.0.1:1"\nworld = "dream"', "", "exactly one of url, checkpoint"),
        ("[imagined.dream]", "[imagined.real]", "names the real world"),
        ('world = "judge"', 'world = "judge"\nprobe = "a"', "of the real world is `probe`"),
        ('"reach far"', '"reach"', "expected no task twice"),
        ('builtin = "hold"', 'builtin = "hold"\nscript = "script 5 mm"', "got builtin, script"),
        ('builtin = "hold"', 'builtin = "hold"\narguments = {a = 1}', "belong to `factory`"),
        ("name =", "name", "cannot be read"),
    ],
)
def test_a_study_that_makes_no_sense_is_refused(tmp_path, old, new, message):
    assert old in STUDY
    with pytest.raises(InvalidInputError, match=message):
        definition_of(STUDY.replace(old, new), tmp_path)


class Spread(toy.ToyWorld):
    """Says how far its members are apart about success, and no more."""

    def step(self, state, actions, **options):
        stepped = super().step(state, actions, **options)
        uncertainty = Uncertainty(disagreement=0, distance=0, success_spread=0.125)
        return replace(stepped, observation=replace(stepped.observation, uncertainty=uncertainty))


@pytest.fixture(scope="module")
def url():
    worlds = {
        "judge": toy.ToyWorld("judge", judge=True),
        "dream": Spread("dream", judge=False, drift_m=0.01),
    }
    with served(create_world_app(worlds, WorldServiceSettings())) as address:
        yield address


def script():
    return toy.replay([toy.demonstration(t, s) for t in toy.TASKS for s in range(2000, 2003)])


class Fragile(HoldPolicy):
    """Fails from one start."""

    def reset(self, start):
        super().reset(start)
        if start.seed == 2001:
            raise RuntimeError("no idea")


@pytest.fixture
def parts(url, probe_checkpoint):
    def connect(connections):
        client = connections.enter_context(RolloutClient(url))
        dream = {"dream": WorldAddress(client, "dream")}
        return StudyWorlds.ask(WorldAddress(client, "judge"), dream)

    return StudyParts(
        connect,
        lambda: {"hold": Fragile(), "script": script()},
        SuccessClassifier(probe_checkpoint),
        toy.INSTRUCTIONS,
    )


@pytest.fixture
def study(tmp_path):
    return definition_of(STUDY, tmp_path)


def header_of(study):
    return StudyHeader(study.name, study.model_dump(mode="json"), {"definition": study.digest})


def test_a_study_gives_the_rows_of_an_evaluation(tmp_path, url, study, parts):
    results = StudyResults.create_or_resume(tmp_path, header_of(study))
    report = run_study(study, results, parts)
    with RolloutClient(url) as client:
        rows = evaluate(
            real=WorldAddress(client, "judge"),
            imagined={"dream": WorldAddress(client, "dream")},
            policies=parts.load_policies(),
            plan=EvaluationPlan(toy.INSTRUCTIONS, study.seeds, study.num_steps),
            probe=parts.probe,
        )
    assert set(report.scores) == set(rows.scores)
    # The policy's own error from one start, in both tasks and worlds: four rows, no more.
    assert {(f.world, f.task, f.seed) for f in report.failures} == {
        (world, task, 2001) for world in ("real", "dream") for task in toy.TASKS
    }
    assert {f.message for f in report.failures} == {f.message for f in rows.failures}
    assert [s.world for s in report.scores] == sorted(
        (s.world for s in report.scores), reverse=True
    )


def test_a_world_with_a_success_classifier_of_its_own_is_scored_by_that(
    tmp_path, url, study, parts, trained_probe
):
    own = SuccessClassifier(trained_probe)
    results = StudyResults.create_or_resume(tmp_path, header_of(study))
    report = run_study(study, results, replace(parts, own_probes={"dream": own}))
    with RolloutClient(url) as client:
        expected = {
            which: evaluate(
                real=WorldAddress(client, "judge"),
                imagined={"dream": WorldAddress(client, "dream")},
                policies=parts.load_policies(),
                plan=EvaluationPlan(toy.INSTRUCTIONS, study.seeds, study.num_steps),
                probe=probe,
            ).scores
            for which, probe in (("real", parts.probe), ("dream", own))
        }
    wanted = {s for which, rows in expected.items() for s in rows if s.world == which}
    assert set(report.scores) == wanted
    assert {s for s in expected["real"] if s.world == "dream"} - wanted


def test_starts_that_the_success_classifier_of_a_world_was_trained_on_are_refused(
    tmp_path, study, parts
):
    seen = EvaluationPlan(toy.INSTRUCTIONS, study.seeds, study.num_steps)
    with ExitStack() as connections:
        real = parts.connect(connections).addresses["real"]
        digests = tuple(start.digest for start in begin_matched(real, seen, parts.probe))
    metadata = parts.probe.metadata.model_copy(update={"training_starts": digests})
    own = copy(parts.probe)
    own.metadata = metadata
    results = StudyResults.create_or_resume(tmp_path, header_of(study))
    with pytest.raises(ConflictError, match="success classifier of world 'dream'"):
        run_study(study, results, replace(parts, own_probes={"dream": own}))


@pytest.mark.slow
def test_an_interrupted_study_ends_as_if_nothing_had_happened(tmp_path, study, parts):
    whole = StudyResults.create_or_resume(tmp_path / "whole", header_of(study))
    expected = run_study(study, whole, parts).to_report()
    results = StudyResults.create_or_resume(tmp_path / "cut", header_of(study))
    keep, kept = results.keep, []

    def keep_some(outcome):
        if len(kept) == 5:
            raise KeyboardInterrupt
        keep(outcome)
        kept.append(outcome)

    results.keep = keep_some
    with pytest.raises(KeyboardInterrupt):
        run_study(study, results, parts)
    resumed = StudyResults.create_or_resume(tmp_path / "cut", header_of(study))
    assert len(resumed.outcomes) == 5
    unfinished = study_report(study, resumed).to_report()
    assert len(unfinished["failures"]) >= study.num_rollouts - 5
    assert {"NotRunYet"} <= {failure["error"] for failure in unfinished["failures"]}
    assert run_study(study, resumed, parts).to_report() == expected
    # With all results there, worlds are not even asked.
    apart = replace(parts, connect=lambda _: pytest.fail("connected"))
    again = StudyResults.create_or_resume(tmp_path / "cut", header_of(study))
    assert run_study(study, again, apart).to_report() == expected
    assert len(again.path.read_text().splitlines()) == 1 + study.num_rollouts


def test_failed_rollouts_are_run_again_on_request(tmp_path, study, parts):
    results = StudyResults.create_or_resume(tmp_path, header_of(study))
    assert len(run_study(study, results, parts).failures) == 4
    mended = replace(parts, load_policies=lambda: {"hold": HoldPolicy(), "script": script()})
    assert len(run_study(study, results, mended).failures) == 4
    report = run_study(study, results, mended, retry_failed=True)
    assert (len(report.failures), len(report.scores)) == (0, study.num_rollouts)


def test_a_world_that_goes_away_stops_the_study_and_costs_no_rows(
    tmp_path, study, parts, probe_checkpoint, monkeypatch
):
    monkeypatch.setattr(http_link, "RETRY_PAUSES_S", ())
    results = StudyResults.create_or_resume(tmp_path, header_of(study))
    app = create_world_app({"dream": toy.ToyWorld("dream", judge=False)}, WorldServiceSettings())
    dying = served(app)
    address = dying.__enter__()
    calls = []

    class Ending(HoldPolicy):
        def reset(self, start):
            super().reset(start)
            calls.append(start)
            if len(calls) == 3:
                dying.__exit__(None, None, None)

    def connect(connections):
        both = parts.connect(connections)
        far = connections.enter_context(RolloutClient(address, patience_s=0.0))
        worlds = {"dream": WorldAddress(far, "dream")}
        return StudyWorlds.ask(both.addresses["real"], worlds)

    policies = {"hold": Ending(), "script": script()}
    failing = replace(parts, connect=connect, load_policies=lambda: policies)
    one_by_one = study.model_copy(update={"in_flight": 1})
    with pytest.raises(UnavailableError):
        run_study(one_by_one, results, failing)
    assert not [o for o in results.outcomes.values() if isinstance(o, RolloutFailure)]


def test_a_real_world_that_goes_away_before_the_starts_costs_no_rows(
    tmp_path, study, parts, monkeypatch
):
    monkeypatch.setattr(http_link, "RETRY_PAUSES_S", ())
    results = StudyResults.create_or_resume(tmp_path, header_of(study))

    def connect(connections):
        worlds = parts.connect(connections)
        gone = connections.enter_context(RolloutClient("http://127.0.0.1:9"))
        addresses = worlds.addresses | {"real": WorldAddress(gone, "judge")}
        return replace(worlds, addresses=addresses)

    with pytest.raises(UnavailableError, match=r"127\.0\.0\.1:9"):
        run_study(study, results, replace(parts, connect=connect))
    assert results.outcomes == {}


def test_a_study_is_run_by_one_process_at_a_time(tmp_path, study, parts):
    results = StudyResults.create_or_resume(tmp_path, header_of(study))
    with results.locked():
        for start in (
            lambda: StudyResults.create_or_resume(tmp_path, header_of(study)),
            lambda: run_study(study, results, parts),
        ):
            with pytest.raises(ConflictError, match="another process is running this study"):
                start()
        assert StudyResults.read(tmp_path).outcomes == {}
    assert run_study(study, results, parts).scores


class Surrogate(HoldPolicy):
    """Names a file that is not UTF-8 in its error."""

    def act(self, observation):
        raise OSError("no file caf\udce9.pt")


def test_errors_that_are_no_text_can_be_read_again(tmp_path, study, parts):
    results = StudyResults.create_or_resume(tmp_path, header_of(study))
    odd = replace(parts, load_policies=lambda: {"hold": Surrogate(), "script": script()})
    report = run_study(study, results, odd)
    assert "caf?.pt" in report.failures[0].message
    assert StudyResults.read(tmp_path).outcomes == results.outcomes


def test_a_study_has_bundled_policies(tmp_path):
    text = STUDY.replace('factory = "toys:script"', 'builtin = "colour-servo"')
    factory = PolicyFactory(definition_of(text, tmp_path), lambda _: pytest.fail("a script"))
    assert [type(one) for one in factory.load().values()] == [HoldPolicy, ColourServo]
    assert factory.training_starts() == factory.digests() == {}


def test_a_study_may_keep_its_rollouts_in_the_store_that_it_replays(tmp_path):
    store, item = EpisodeStore(tmp_path / "store"), toy.demonstration("reach", 2000)
    toy_store.write(store, item)
    text = STUDY.replace('factory = "toys:script"', f'replay = "{store.root}"')
    study = definition_of(text, tmp_path)
    before = PolicyFactory(study, lambda _: pytest.fail("a script")).digests()
    for world, origin in (("real", "twin"), ("dream", "imagined")):
        lineage = ({"kind": "rollout", "id": f"toy: script in {world}"},)
        toy_store.write(store, item, episode_id=world, origin=origin, lineage=lineage)
    again = PolicyFactory(study, lambda _: pytest.fail("a script"))
    assert again.digests() == before
    again.load()["script"].reset(PolicyStart("reach", "", 2000, toy.ANCHOR, toy.K_HEAD))


def test_changed_policies_are_another_study(tmp_path, policy_checkpoint):
    path = tmp_path / "cloned.safetensors"
    text = STUDY.replace(
        'builtin = "hold"', f'builtin = "behaviour-cloning"\ncheckpoint = "{path}"'
    )
    factory = PolicyFactory(definition_of(text, tmp_path), lambda _: pytest.fail("a script"))
    save_checkpoint(path, policy_checkpoint)
    before = factory.digests()
    assert set(before) == {"policy hold"}
    path.write_bytes(path.read_bytes() + b"\0")
    assert factory.digests() != before


def test_milestones_of_a_rollout_are_unknown_not_missed(tmp_path, study, parts):
    store = EpisodeStore(tmp_path / "rollouts")
    results = StudyResults.create_or_resume(tmp_path, header_of(study))
    run_study(study, results, replace(parts, store=store))
    failed = store.open(
        rollout_episode_id(results.header, PlannedRollout("real", "reach", 2000, "hold", 0))
    )
    assert failed.attributes.success is False
    assert read_ending_episode(failed).event_times_s is None
    rubric = Rubric.model_validate(
        {"criteria": [{"name": "reached", "points": 1, "description": "r", "milestone": "r"}]}
    )
    rated = rated_rollouts(store, ("reach",))
    assert state_scores(store, rated, {"reach": rubric}) == {}


def test_repeats_differ_by_their_noise_and_count_as_one_start(tmp_path, study, parts):
    study = study.model_copy(update={"repeats": 3, "tasks": ("reach",)})
    results = StudyResults.create_or_resume(tmp_path, header_of(study))
    report = run_study(study, results, parts)
    assert len([s for s in report.scores if s.world == "dream"]) == 3 * (3 + 2)
    row = {r["policy"]: r for r in report.policy_rows()}["script"]
    assert (row["real_rollouts"], row["imagined_rollouts"]) == (3, 9)
    assert report.outcomes("dream", "reach").shape == (2, 3)


def test_repeated_starts_are_rated_by_their_share():
    """By hand: shares 1, 1/3 and 0 of three starts are 4/9, of three trials and not nine."""
    successes = {0: (1, 1, 1), 1: (1, 0, 0), 2: (0, 0, 0)}
    scores = [
        RolloutScore("dream", "a", "reach", seed, f"{seed}", bool(one), 0.5, repeat=n)
        for seed, ones in successes.items()
        for n, one in enumerate(ones)
    ]
    real = [
        RolloutScore("real", "a", "reach", s, f"{s}", success=True, probability=1.0)
        for s in range(3)
    ]
    report = ClosedLoopReport((*real, *scores), ("dream",), ("a",))
    row = report.policy_rows()[0]
    assert row["imagined"] == pytest.approx(4 / 9)
    # Wilson's interval of 4/9 with n = 3: centre (p + z²/2n)/(1 + z²/n), by hand.
    z2 = 1.959964**2
    centre = (4 / 9 + z2 / 6) / (1 + z2 / 3)
    assert np.mean(row["imagined_interval"]) == pytest.approx(centre, abs=1e-5)
    assert report.outcomes("dream", "reach").tolist() == [[1.0, pytest.approx(1 / 3), 0.0]]


def test_kept_rollouts_hold_what_the_worlds_returned(tmp_path, url, study, parts):
    store = EpisodeStore(tmp_path / "rollouts")
    results = StudyResults.create_or_resume(tmp_path, header_of(study))
    report = run_study(study, results, replace(parts, store=store))
    assert len(store.list()) == len(report.scores)
    cell = PlannedRollout("dream", "reach", 2000, "script", 0)
    episode = store.open(rollout_episode_id(results.header, cell))
    about = episode.attributes
    assert (about.origin, about.success, about.task, about.seed) == (
        "imagined",
        None,
        "reach",
        2000,
    )
    judged = store.open(rollout_episode_id(results.header, cell._replace(world="real"))).attributes
    assert (judged.origin, judged.success) == ("twin", True)
    assert (about.quality, judged.quality) == ({"imagined_success_spread": 0.125}, {})
    # The same rollout by hand, over HTTP.
    demonstration = toy.demonstration("reach", 2000)
    with RolloutClient(url) as client:
        real = client.start(world="judge", task="reach", seed=2000, instruction="")
        init = (real.observation, real.anchor, real.K_head)
        rollout = client.start(world="dream", task="reach", seed=2000, instruction="", init=init)
        seen = [rollout.observation]
        seen += [rollout.step(demonstration.commanded[n : n + 16]) for n in range(1, 81, 16)]
    window = episode.window(0, episode.num_steps, cameras=("camera_head",))
    assert episode.num_steps == 81
    for name, array in (("tactile_kpa", window.tactile_kpa), ("action_reached", window.actions)):
        expected = np.concatenate([getattr(one, name) for one in seen])
        np.testing.assert_allclose(array, expected, atol=1e-5)
    images = np.concatenate([one.images["camera_head"] for one in seen]).astype(float)
    assert np.abs(window.images["camera_head"] - images).mean() < 3
    # The report shows a pair of every task, of the rollouts that were kept.
    pairs = kept_pairs(report, "dream", results)
    assert [pair.title.split(",")[0] for pair in pairs] == list(toy.TASKS)
    # Of their 81 steps those of five seconds at 15 Hz.
    assert {pair.true_images.shape[0] for pair in pairs} == {76}
    write_reports(results, None)
    page = (tmp_path / "report dream.html").read_text(encoding="utf-8")
    assert page.count("data:image/webp") == 2 * len(toy.TASKS)  # moving and still
    np.testing.assert_allclose(
        episode.read("action_commanded").values[1:], demonstration.commanded[1:]
    )
    # A kept rollout that is damaged is not shown, and costs no report.
    for name in store.list():
        if store.open(name).attributes.task == toy.TASKS[0]:
            (store.root / f"episodes/{name}/tactile_left/c/0/0").write_bytes(b"")
    write_reports(results, None)
    page = (tmp_path / "report dream.html").read_text(encoding="utf-8")
    assert page.count("data:image/webp") == 2 * (len(toy.TASKS) - 1)


def test_a_start_that_was_trained_on_is_refused(tmp_path, study, parts):
    results = StudyResults.create_or_resume(tmp_path, header_of(study))
    run_study(study, results, parts)
    digest = next(iter(results.outcomes.values())).start_digest
    fresh = StudyResults.create_or_resume(tmp_path / "other", header_of(study))
    with pytest.raises(ConflictError, match="trained on by the policy"):
        run_study(study, fresh, replace(parts, trained_on={"the policy": (digest,)}))
    assert fresh.outcomes == {}


def test_the_report_is_plain_json(tmp_path, study, parts):
    results = StudyResults.create_or_resume(tmp_path, header_of(study))
    json.dumps(run_study(study, results, parts).to_report(), allow_nan=False)
