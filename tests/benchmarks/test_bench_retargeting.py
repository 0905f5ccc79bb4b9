"""`python -m benchmarks retargeting`: a quick run, its rivals and its verdicts."""

import json
import signal
import subprocess
import sys
import xml.etree.ElementTree as ET
from contextlib import contextmanager

import numpy as np
import pytest

from benchmarks.command import stage_parser
from benchmarks.figures import Figure
from benchmarks.retargeting import benchmark, compare, rival_process, rivals
from benchmarks.retargeting.benchmark import requirements, tables, velocity_limit_deg, worst_ratio
from benchmarks.retargeting.compare import (
    OURS,
    OURS_EXACT,
    OURS_LIVE,
    PINCH_INPUT,
    ROBOT_INPUT,
    ColdStart,
    Effort,
    PinchScore,
    RobotScore,
    Speed,
    compare_robot,
    compare_speed,
    faulty_motions,
    scale_of,
    score_robot,
    try_faults,
)
from benchmarks.retargeting.rival_process import RivalProcess
from benchmarks.retargeting.rivals import RIVALS, hand_urdf
from benchmarks.simulated.hand_motions import cold_postures, people, pinch_motion, robot_motion
from dextouch.errors import (
    InvalidInputError,
    LimitExceededError,
    UnavailableError,
    UnknownNameError,
)
from dextouch.hands.robot_hand import RobotHand

SIDES = ("left", "right")
DEX = RIVALS["dex vector15"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A quick run in a process of its own, as shape checks must not be timed."""
    folder = tmp_path_factory.mktemp("bench")
    command = [sys.executable, "-m", "benchmarks", "retargeting", "--quick"]
    outputs = ["--rivals", "none", "--out", str(folder)]
    done = subprocess.run([*command, *outputs], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder, json.loads((folder / "bench_retargeting.json").read_text())


@pytest.mark.slow
def test_a_quick_run_measures_ours_everywhere(run):
    _, figures = run
    assert {(one["method"], one["motion"]) for one in figures["speed"]} == {
        (method, motion) for method in (OURS, OURS_LIVE) for motion in (ROBOT_INPUT, PINCH_INPUT)
    }
    assert all(min(one["cpu_us"]) > 0 for one in figures["speed"])
    assert len(figures["robot"]) == 4
    assert all(list(scores) == [OURS, OURS_EXACT] for scores in figures["robot"].values())
    assert figures["pinches"][OURS]["num_pinched"] > 200
    assert [one["text"][:9] for one in figures["faults"]] == ["continues"] * 3


@pytest.mark.slow
def test_promises_that_need_no_quiet_machine_are_kept(run):
    _, figures = run
    verdicts = {row["what"]: row["verdict"] for row in figures["requirements"]}
    speed = [what for what in verdicts if "times as fast as" in what]
    assert len(speed) == 2
    assert {verdicts[what] for what in speed} == {"not measured"}
    for what, verdict in verdicts.items():
        # A hundred postures are too few for a share of 0.999, two seconds too few for means.
        if what not in speed and "one start" not in what and "1 mm noise" not in what:
            assert verdict == "pass", what


@pytest.mark.slow
def test_the_chart_has_our_point_in_both_panels(run):
    folder, _ = run
    chart = ET.parse(folder / "bench_retargeting.svg").getroot()  # noqa: S314 (ours)
    names = [g.get("id", "") for g in chart.iter("{http://www.w3.org/2000/svg}g")]
    assert sum(one.endswith(": ours") for one in names) == 2


def bones_m(hand):
    points = hand.chain_points_m(np.zeros((1, 20)))[0]
    return np.linalg.norm(np.diff(points, axis=1), axis=-1)


@pytest.mark.parametrize("side", SIDES)
def test_the_urdf_moves_like_the_hand(side):
    mujoco = pytest.importorskip("mujoco")
    hand = RobotHand(side)
    # MuJoCo wants masses, and would melt the tips into the last links.
    compiler = '<mujoco><compiler fusestatic="false" boundmass="1" boundinertia="1"/></mujoco>'
    text = hand_urdf(hand).replace("<link ", f"{compiler}<link ", 1)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    joints = cold_postures(side, 5, 0).joints_rad
    for posture, tips in zip(joints, hand.fingertips_m(joints), strict=True):
        for name, angle in zip(hand.joint_names, posture, strict=True):
            data.qpos[model.joint(name).qposadr[0]] = angle
        mujoco.mj_kinematics(model, data)
        found = [data.body(f"{c}_tip").xpos for c in ("thumb", "index", "middle", "ring", "little")]
        np.testing.assert_allclose(found, tips, atol=1e-9)
    limits = np.array([model.joint(name).range for name in hand.joint_names])
    np.testing.assert_allclose(limits, np.column_stack([hand.lower_rad, hand.upper_rad]))


def fake_rival(solve, joint_names=None):
    def set_up(rival, keypoints_m, side, *, scale, folder):
        names = list(joint_names or RobotHand(side).joint_names)
        return rivals.Setup(list(keypoints_m), solve, names)

    return set_up


def test_a_rivals_joints_are_put_in_order_by_name(monkeypatch):
    names = list(RobotHand("left").joint_names)
    monkeypatch.setattr(
        rival_process, "set_up", fake_rival(lambda _: np.arange(20.0), sorted(names))
    )
    asked = {"side": "left", "scale": 1.0, "keypoints_m": np.zeros((3, 25, 3)).tolist()}
    answers = []
    monkeypatch.setattr(
        rival_process, "serve_parent", lambda niceness: (iter([asked]), answers.append)
    )
    rival_process.serve("dex vector15")
    (answer,) = answers
    assert len(answer["call_s"]) == 3
    assert [sorted(names)[int(value)] for value in answer["joints_rad"][2]] == names


# The time limit of tests is such an alarm itself.
@pytest.mark.timeout(0)
def test_the_alarm_counts_processor_time_and_is_not_left_behind():
    found = []

    def solve(_):
        found.append(
            (signal.getitimer(signal.ITIMER_PROF)[0], signal.getitimer(signal.ITIMER_REAL))
        )
        raise ValueError("not this one")

    try:
        with pytest.raises(ValueError, match="not this one"):
            rival_process.follow(rivals.Setup([np.zeros(45)], solve, []))
        assert signal.getitimer(signal.ITIMER_PROF) == (0.0, 0.0)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    # A busy machine takes any time on the wall.
    assert found[0][0] == pytest.approx(rival_process.CALL_LIMIT_S, abs=1.0)
    assert found[0][1] == (0.0, 0.0)


CHILD = """
import sys, time
from benchmarks.retargeting import rival_process, rivals
def solve(reference):
    if reference[0, 0] == 1.0:
        raise ValueError("ones are not for me")
    if reference[0, 0] == 3.0:
        sys.exit(5)
    while reference[0, 0] == 2.0:
        pass
    print("words that are no answer")
    return [0.5] * 20
def set_up(rival, keypoints_m, side, *, scale, folder):
    names = rival_process.RobotHand(side).joint_names
    return rivals.Setup(list(keypoints_m), solve, list(names))
rival_process.set_up = set_up
rival_process.CALL_LIMIT_S = 1.0
rival_process.serve(sys.argv[1])
"""


@pytest.fixture
def run_as_rival(monkeypatch, tmp_path):
    """Lets the module of this text be the process of every rival."""

    def run(text):
        (tmp_path / "a_rival.py").write_text(text)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.setattr(rival_process, "MODULE", "a_rival")

    return run


@pytest.mark.slow
def test_a_rival_that_refuses_hangs_or_dies_does_not_end_the_run(run_as_rival):
    run_as_rival(CHILD)
    motion = robot_motion("right", 30, 0, natural=True)
    faulty = {}
    for kind in (1.0, 2.0, 3.0):
        keypoints = motion.keypoints_m.copy()
        keypoints[9, 0, 0] = kind
        faulty[kind] = type(motion)(**{**vars(motion), "keypoints_m": keypoints})
    with RivalProcess(DEX) as process:
        assert (process.run(motion, 1.0).joints_rad == 0.5).all()
        with pytest.raises(InvalidInputError, match="ones are not for me"):
            process.run(faulty[1.0], 1.0)
        assert process.run(motion, 1.0).call_s.shape == (30,)
        with pytest.raises(LimitExceededError, match="did not return"):
            process.run(faulty[2.0], 1.0)
        assert (process.run(motion, 1.0).joints_rad == 0.5).all()
        with pytest.raises(UnavailableError, match="status 5"):
            process.run(faulty[3.0], 1.0)


@pytest.mark.slow
def test_a_rival_that_does_not_finish_is_a_row(monkeypatch, run_as_rival):
    # It takes its time at the first sample of all.
    endless = CHILD.replace("while reference[0, 0] == 2.0:", "while True:")
    run_as_rival(endless.replace("1.0\n", "0.2\n"))
    motion = robot_motion("right", 30, 0, natural=True)
    sets = {"natural range": [motion]}
    monkeypatch.setattr(compare, "_timed_motions", lambda name, effort: [motion])
    with RivalProcess(DEX) as process:
        processes = {DEX.name: process}
        scores = compare_robot(sets, processes, no_bar)
        timed = compare_speed(Effort(1, 30, 1, 1, 1, 0), processes, no_bar)
    assert list(scores["natural range"]) == [OURS, OURS_EXACT]
    assert {one.method for one in timed} == {OURS, OURS_LIVE}
    shown = tables(timed, scores, {}, ColdStart(1, 1, 1), [], [DEX.name])
    assert [table.rows[-1][:2] for table in shown[:4]] == [(DEX.name, "did not finish")] * 4
    assert all(len(row) == len(table.columns) for table in shown for row in table.rows)
    assert worst_ratio(timed, OURS, DEX.name) is None


@pytest.mark.parametrize("name", RIVALS)
def test_every_rival_follows_the_robot_when_installed(name):
    """A rival that is called wrongly would lose for the wrong reason."""
    missing = rivals.missing_modules(RIVALS[name])
    if missing:
        pytest.skip(f"{', '.join(missing)} not installed; {rivals.INSTALL}")
    for side in SIDES:
        motion = robot_motion(side, 60, 0, natural=True)
        with RivalProcess(RIVALS[name]) as process:
            score = score_robot([motion], [process.run(motion, scale_of(motion)).joints_rad])
        assert score.tip_mean_mm < 8


def test_references_are_what_each_objective_follows():
    motion = robot_motion("right", 30, 0, natural=True)
    vectors, positions, pairs = (
        rivals.references(RIVALS[f"dex {objective}"], motion.keypoints_m, 2.0)
        for objective in (rivals.VECTOR, rivals.POSITION, rivals.DEXPILOT)
    )
    np.testing.assert_allclose(vectors[:, 2::3], motion.tips_m)
    np.testing.assert_allclose(positions, 2 * vectors)
    tips = motion.tips_m
    np.testing.assert_allclose(pairs[:, 0], tips[:, 0] - tips[:, 1])
    np.testing.assert_allclose(pairs[:, 9], tips[:, 3] - tips[:, 4])
    np.testing.assert_allclose(pairs[:, 10:], tips)


def test_rivals_that_are_not_installed_are_named_with_the_way_to_get_them(monkeypatch, tmp_path):
    monkeypatch.setattr(rivals, "find_spec", lambda name: None if name == "nlopt" else object())
    chosen, left_out = benchmark.choose_rivals(None)
    assert [one.library for one in chosen] == ["dexi"] * 3
    assert [one.library for one in left_out] == ["dex"] * 3
    text = benchmark.notes(chosen, left_out)[-1]
    assert "dex dexpilot not measured: nlopt not installed; pip install" in text
    assert benchmark.choose_rivals("none") == ([], [])
    assert [one.name for one in benchmark.choose_rivals("dexi vector15")[0]] == ["dexi vector15"]
    with pytest.raises(UnknownNameError, match="dexi vector15"):
        benchmark.choose_rivals("mink")
    with pytest.raises(UnavailableError, match="nlopt"):
        rivals.set_up(DEX, np.zeros((1, 25, 3)), "left", scale=1.0, folder=tmp_path)


def test_a_scale_is_the_ratio_of_fingers():
    assert scale_of(robot_motion("left", 120, 0, natural=True)) == pytest.approx(1, abs=1e-3)
    person = people("right", 0)[0]
    expected = bones_m(RobotHand("right")).sum() / bones_m(person).sum()
    assert scale_of(pinch_motion(person, "right")) == pytest.approx(expected, rel=0.01)


@contextmanager
def no_bar(what, num_steps):
    yield lambda name: None


def test_ours_goes_on_through_every_fault():
    motions = faulty_motions(0)
    lost = [np.isnan(motion.keypoints_m).any(axis=-1).sum() for motion in motions.values()]
    assert lost[0] == 1
    assert lost[1] == 25
    assert lost[2] > 10
    outcomes = try_faults(0, {}, no_bar)
    assert [one.fault for one in outcomes] == list(motions)
    assert all(one.text.startswith("continues") for one in outcomes)


def speeds(ours_us, live_us, dex_us, dexi_us):
    times = {OURS: ours_us, OURS_LIVE: live_us, "dex vector15": dex_us, "dexi vector15": dexi_us}
    return [
        Speed(method, motion, Figure.of([us * slower for us in row]), None)
        for method, row in times.items()
        for motion, slower in ((ROBOT_INPUT, 1.0), (PINCH_INPUT, 1.0 if "ours" in method else 0.5))
    ]


def test_ratios_are_of_the_worse_input():
    found = speeds([10.0, 20.0], [20.0, 40.0], [4000.0, 8000.0], [100.0, 200.0])
    assert worst_ratio(found, OURS, "dex vector15") == 200
    assert worst_ratio(found, OURS_LIVE, "dexi vector15") == 2.5
    assert worst_ratio(found, OURS, "mink") is None


def test_requirements_say_what_failed():
    good = RobotScore(1.2, 2.0, 0.0009, 1.6, 0.009, 0, velocity_limit_deg())
    bad = RobotScore(1.31, 2.0, 0.002, 1.71, 0.02, 1, velocity_limit_deg() + 1e-3)
    names = ("natural range", "full range", "natural, 1 mm noise", "full, 1 mm noise")
    pinches = {OURS: PinchScore(1.4, 2.4, 4.9, 9.0, 0, 10)}
    fast = speeds([10.0], [10.0], [4000.0], [110.0])
    passed = requirements(
        fast,
        {name: {OURS: good, OURS_EXACT: good} for name in names},
        pinches,
        ColdStart(10, 10, 10),
    )
    assert [row.verdict() for row in passed] == ["pass"] * 14
    wide = {OURS: PinchScore(1.6, 2.6, 5.1, 9.0, 0, 10)}
    slow = speeds([20.0], [20.0], [2900.0], [90.0])
    failed = requirements(
        slow,
        {name: {OURS: bad, OURS_EXACT: bad} for name in names},
        wide,
        ColdStart(2000, 1997, 1999),
    )
    assert [row.verdict() for row in failed] == ["FAIL"] * 14


@pytest.mark.parametrize("words", [["--rounds", "0"], ["--samples", "5"], ["--seed", "-1"]])
def test_runs_that_measure_nothing_are_refused(words, tmp_path):
    parser = stage_parser("retargeting")
    benchmark.add_options(parser)
    with pytest.raises(InvalidInputError, match=words[0]):
        benchmark.measure(parser.parse_args(words), tmp_path, no_bar)
