"""`dextouch evaluate recorded`: the policies that it takes, and what it refuses at once."""

import pytest

from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError, NotFoundError, UnknownNameError
from services.cli import main
from services.evaluation.bundled_policies import BUNDLED, bundled_policy
from services.evaluation.recorded_takes import REPLAY
from services.pipelines import evaluate
from services.pipelines.parsers import recorded_parser

HOLD = "services.evaluation.policies.open_loop:HoldPolicy"


def policies(*words):
    parsed = recorded_parser().parse_args(["--episodes", "takes", *words])
    return evaluate._policies(parsed)


def test_policies_have_the_names_that_they_are_given():
    assert list(policies("--policy", f"mine={HOLD}", "--hold")) == ["mine", "hold"]


@pytest.mark.parametrize("name", BUNDLED)
def test_every_built_in_policy_is_offered(name):
    found = policies("--builtin", name, "--hold", "--builtin", "hold")
    assert list(found) == list(dict.fromkeys([name, "hold"]))
    assert type(found[name]) is type(bundled_policy(name))


@pytest.mark.parametrize("name", ["hold", REPLAY])
def test_two_policies_of_one_name_are_refused(name):
    with pytest.raises(InvalidInputError, match=f"'{name}' is given twice"):
        policies("--policy", f"{name}={HOLD}", "--hold", "--policy", f"{name}={HOLD}")


@pytest.mark.parametrize(
    "words", [["--cloned", "a=x", "--cloned", "a=y"], ["--cloned", "hold=x", "--hold"]]
)
def test_two_cloned_policies_of_one_name_are_renamed_by_their_own_option(words):
    with pytest.raises(InvalidInputError, match="rename one, --cloned NAME=CHECKPOINT"):
        policies(*words)


def test_arguments_of_an_unknown_policy_are_refused():
    with pytest.raises(UnknownNameError, match="yours"):
        policies("--policy", f"mine={HOLD}", "--policy-arguments", '{"yours": {}}')


@pytest.mark.parametrize("wrong", [["--policy-arguments", "[1]"], ["--cloned", "no-name"]])
def test_malformed_words_are_refused(wrong, capsys):
    with pytest.raises(SystemExit):
        policies(*wrong)
    assert "expected" in capsys.readouterr().err


def test_a_store_without_takes_is_refused(tmp_path, capsys):
    EpisodeStore(tmp_path)
    with pytest.raises(NotFoundError, match=r"store 1 of 1, .* has none"):
        evaluate.recorded_main(["--episodes", str(tmp_path)])
    assert main.main(["evaluate", "recorded", "--episodes", str(tmp_path)]) == 3
    assert "has none; check its path" in capsys.readouterr().err
