"""The commands `dextouch study run` and `dextouch study report`, and worlds of a study."""

import argparse
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from dextouch.clients import RolloutClient
from dextouch.episodes import EpisodeStore
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError
from dextouch.serving import ChildProcess
from services.evaluation.command_line import (
    EXIT_FAILED,
    instructions_for,
    print_failures,
    print_scores,
)
from services.evaluation.policies.replay import ReplayPolicy
from services.evaluation.scores import REAL
from services.evaluation.settings import DEFAULT_PROBE
from services.evaluation.studies.definition import StudyDefinition, WorldChoice, read_definition
from services.evaluation.studies.engine import PolicyFactory, StudyParts, file_digest, run_study
from services.evaluation.studies.results import StudyHeader, StudyResults, cells_of
from services.evaluation.studies.study_figures import REPORT_FILE, write_reports
from services.evaluation.study_worlds import StudyWorlds, WorldAddress
from services.evaluation.success_classifier import SuccessClassifier
from services.pipelines.parsers import study_parser
from services.pipelines.training_data import stage_of
from services.twin.scripted_actions import scripted_actions
from services.world_model.shipped_checkpoints import default_checkpoint
from services.world_model.state_checkpoints import is_state_checkpoint, read_state_checkpoint

_CHILD = "services.pipelines.study.world_process"


def main(arguments: list[str]) -> int:
    """Run `dextouch study COMMAND`.

    Returns:
        0, or 1 if a rollout failed or has no result yet.
    """
    options = study_parser().parse_args(arguments)
    return _report(options) if options.word == "report" else _run(options)


def _run(options: argparse.Namespace) -> int:
    definition = read_definition(options.study)
    folder = options.folder or options.study.with_suffix("")
    refuse_training_seeds(definition)
    probe_path = definition.probe or DEFAULT_PROBE
    probe = SuccessClassifier.load(probe_path)
    own_probes = _own_probes(definition, probe)
    instructions = instructions_for(definition.tasks, probe.metadata.settings["instructions"])
    policies = PolicyFactory(definition, partial(demonstrator, definition.tasks, definition.seeds))
    policies.load()
    with served_worlds(definition) as addresses:
        digests = {"definition": definition.digest, "probe": file_digest(probe_path)}
        digests |= {f"probe of {name}": file_digest(path) for name, path in own_paths(definition)}
        digests |= policies.digests()
        with ExitStack() as connections:
            digests |= connect(addresses, connections).digests
        header = StudyHeader(definition.name, definition.model_dump(mode="json"), digests)
        results = StudyResults.create_or_resume(folder, header)
        num_cells = sum(1 for _ in cells_of(definition))
        store = (
            EpisodeStore(options.store or folder / "rollouts") if definition.keep_rollouts else None
        )
        if store is not None:
            # What a killed run left unfinished.
            store.sweep()
        print(f"{definition.name}: {len(results.outcomes)} of {num_cells} rollouts have a result")
        run_study(
            definition,
            results,
            StudyParts(
                partial(connect, addresses),
                policies.load,
                probe,
                instructions,
                policies.training_starts(),
                store,
                own_probes,
            ),
            retry_failed=options.retry_failed,
        )
    return _finish(results, options.json)


def own_paths(definition: StudyDefinition) -> list[tuple[str, Path]]:
    """Names of worlds that have a success classifier of their own, and its file."""
    return [(name, one.probe) for name, one in definition.imagined.items() if one.probe is not None]


def _own_probes(
    definition: StudyDefinition, probe: SuccessClassifier
) -> dict[str, SuccessClassifier]:
    """Success classifiers of single worlds, by world.

    Raises:
        InvalidInputError: one does not know a task of the study, or sees images of another size
            than `probe`.
        NotFoundError, CorruptDataError: a checkpoint that cannot be read.
    """
    own: dict[str, SuccessClassifier] = {}
    for name, path in own_paths(definition):
        own[name] = SuccessClassifier.load(path)
        instructions_for(definition.tasks, own[name].metadata.settings["instructions"])
        size_px, expected_px = own[name].shape.image_size_px, probe.shape.image_size_px
        if size_px != expected_px:
            raise InvalidInputError(
                f"world {name!r}: its success classifier {path} sees images of {size_px} px, "
                f"expected {expected_px} as the study's; train both with the same --image-px"
            )
    return own


def _report(options: argparse.Namespace) -> int:
    return _finish(StudyResults.read(options.folder), options.json)


def _finish(results: StudyResults, json_path: Path | None) -> int:
    figures = write_reports(results, json_path)
    print_scores(figures)
    print_failures(figures, results.path)
    print(f"\nreport: {results.path.with_name(REPORT_FILE)}")
    return EXIT_FAILED if figures["failures"] else 0


@dataclass(frozen=True)
class Address:
    """Where a world is served."""

    url: str
    world: str
    api_key: str | None = None


@contextmanager
def served_worlds(definition: StudyDefinition) -> Iterator[dict[str, Address]]:
    """Addresses of all worlds by name; those without a URL are served until the block ends.

    Raises:
        UnavailableError: a process could not serve its world; its messages are above.
        InvalidInputError: a checkpoint that cannot be served, or a key's variable is not set.
    """
    choices = {REAL: definition.real, **definition.imagined}
    with ExitStack() as children:
        started: dict[str, ChildProcess] = {}
        for name, choice in choices.items():
            if choice.url is None:
                kind = "builtin" if choice.builtin else "checkpoint"
                value = choice.builtin or str(choice.checkpoint)
                started[name] = ChildProcess(
                    _CHILD,
                    kind,
                    value,
                    str(definition.in_flight),
                    environment={"OMP_NUM_THREADS": "1"},
                )
                children.callback(started[name].close)
        served = {name: child.receive() for name, child in started.items()}
        for name, answer in served.items():
            if "refused" in answer:
                raise InvalidInputError(f"world {name!r}: {answer['refused']}")
        yield {
            name: Address(**served[name]) if name in served else _address(name, choice)
            for name, choice in choices.items()
        }


def _address(name: str, choice: WorldChoice) -> Address:
    key, variable = None, choice.api_key_variable
    if variable is not None and (key := os.environ.get(variable)) is None:
        raise InvalidInputError(
            f"world {name!r}: its API key is expected in the variable {variable}, which is not set"
        )
    return Address(str(choice.url), str(choice.world), key)


def connect(addresses: Mapping[str, Address], connections: ExitStack) -> StudyWorlds:
    """Open connections to all worlds and ask what they are."""
    opened = {
        name: WorldAddress(
            connections.enter_context(RolloutClient(one.url, one.api_key)), one.world
        )
        for name, one in addresses.items()
    }
    real = opened.pop(REAL)
    return StudyWorlds.ask(real, opened)


def refuse_training_seeds(definition: StudyDefinition) -> None:
    """Refuse starts whose task and seed a world model was trained on.

    Raises:
        ConflictError: a start was trained on.
        NotFoundError: a checkpoint is missing.
    """
    for name, choice in definition.imagined.items():
        path = default_checkpoint() if choice.builtin == "world-model" else choice.checkpoint
        if path is None:
            continue
        if not path.is_file():
            raise NotFoundError(
                f"world {name!r}: no checkpoint {path}; train it, or check the path"
            )
        if is_state_checkpoint(path):
            refuse_trained(name, path, definition.tasks, definition.seeds)


def refuse_trained(name: str, checkpoint: Path, tasks: Sequence[str], seeds: Sequence[int]) -> None:
    """Refuse starts whose task and seed a state model was trained on.

    Content digests miss them where image size or simulator changed since.

    Raises:
        ConflictError: a start was trained on.
    """
    metadata = read_state_checkpoint(checkpoint).metadata
    for task in tasks:
        trained = [seed for seed in seeds if metadata.may_have_seen(task, seed)]
        if trained:
            low, high = metadata.training_seeds[task]
            raise ConflictError(
                f"world {name!r}: trained on task {task!r} with seeds {low} … {high}, and seed "
                f"{trained[0]} is among those to start from; choose another first_seed, or train "
                "on others"
            )


def demonstrator(tasks: Sequence[str], seeds: Sequence[int], script: str) -> ReplayPolicy:
    """The twin's demonstrator, planned for all starts without simulation.

    Raises:
        UnknownNameError: no such script or task.
    """
    return ReplayPolicy(
        {
            (task, seed): scripted_actions(stage_of(task, "robot"), seed, script)
            for task in tasks
            for seed in seeds
        }
    )
