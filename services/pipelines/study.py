"""The commands `dextouch study run` and `dextouch study report`, and worlds of a study."""

import argparse
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from dextouch.episodes import EpisodeStore
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError
from dextouch.jobs import Workers, results_of, run_jobs
from dextouch.serving import ChildProcess
from services.evaluation import command_line
from services.evaluation.matched_starts import StudyWorlds
from services.evaluation.policies.open_loop import ReplayPolicy
from services.evaluation.progress import Progress
from services.evaluation.scores import REAL, Outcome
from services.evaluation.settings import DEFAULT_PROBE, ServedWorld
from services.evaluation.studies.engine import (
    PolicyFactory,
    StudyParts,
    missing_rollouts,
    run_rollouts,
    run_study,
)
from services.evaluation.studies.results import (
    KEPT_FOLDER,
    PlannedRollout,
    StudyDefinition,
    StudyHeader,
    StudyResults,
    WorldChoice,
    planned_rollouts_of,
    read_definition,
)
from services.evaluation.studies.study_figures import REPORT_FILE, write_pictures, write_reports
from services.evaluation.success_classifier import SuccessClassifier
from services.networks.weight_files import digest_of
from services.pipelines.parsers import study_parser
from services.pipelines.training_data import stage_of
from services.twin.stage import scripted_actions
from services.world_model.checkpoints import is_state_checkpoint, read_state_checkpoint
from services.world_model.shipped_checkpoints import default_checkpoint

# Chosen: a block opens its worlds anew, in some ten seconds, and plays all policies from these.
_STARTS_IN_A_BLOCK = 10
_CHILD = "services.pipelines.study_world"


def main(arguments: list[str]) -> int:
    """Run `dextouch study COMMAND`; returns 0, or 1 if a rollout failed or has no result yet."""
    options = study_parser().parse_args(arguments)
    if options.word == "report":
        return _finish(StudyResults.read(options.folder), options.json)
    return _run(options)


def _run(options: argparse.Namespace) -> int:
    definition = read_definition(options.study)
    folder = options.folder or options.study.with_suffix("")
    refuse_training_seeds(definition)
    store_url = str(options.store or folder / KEPT_FOLDER) if definition.keep_rollouts else None
    addresses = dict[str, ServedWorld]()
    parts, digests = _parts(definition, addresses, store_url)
    with served_worlds(definition) as served:
        addresses |= served
        digests["definition"] = definition.digest
        with ExitStack() as connections:
            digests |= connect(addresses, connections).digests
        header = StudyHeader(definition.name, definition.model_dump(mode="json"), digests)
        results = StudyResults.create_or_resume(folder, header)
        num_planned = sum(1 for _ in planned_rollouts_of(definition))
        if parts.store is not None:
            # What a killed run left unfinished.
            parts.store.sweep()
        print(f"{definition.name}: {len(results.outcomes)} of {num_planned} rollouts have a result")
        if options.ray is None:
            run_study(definition, results, parts, retry_failed=options.retry_failed)
    if options.ray is not None:
        with results.locked():
            missing = missing_rollouts(definition, results, retry_failed=options.retry_failed)
            _run_on_cluster(definition, missing, results, store_url, options.ray)
    return _finish(results, options.json)


def _parts(
    definition: StudyDefinition, addresses: Mapping[str, ServedWorld], store_url: str | None
) -> tuple[StudyParts, dict[str, str]]:
    """What the rollouts of a study need, and digests of the files among it.

    `addresses` are those of its worlds by name, at the latest when rollouts begin.
    """
    probe_path = definition.probe or DEFAULT_PROBE
    probe = SuccessClassifier.load(probe_path)
    policies = PolicyFactory(definition, partial(demonstrator, definition.tasks, definition.seeds))
    policies.load()
    digests = {"probe": digest_of(probe_path), **policies.digests()}
    digests |= {f"probe of {name}": digest_of(path) for name, path in _own_paths(definition)}
    parts = StudyParts(
        partial(connect, addresses),
        policies.load,
        probe,
        command_line.instructions_for(definition.tasks, probe.metadata.settings["instructions"]),
        policies.training_starts(),
        None if store_url is None else EpisodeStore(store_url),
        _own_probes(definition, probe),
    )
    return parts, digests


@dataclass(frozen=True)
class _Block:
    """Rollouts of one world from some starts of a task, of which alone the definition is."""

    definition: StudyDefinition
    rollouts: tuple[PlannedRollout, ...]
    header: StudyHeader
    store_url: str | None


def _run_on_cluster(
    definition: StudyDefinition,
    missing: Sequence[PlannedRollout],
    results: StudyResults,
    store_url: str | None,
    ray_address: str,
) -> None:
    """Run rollouts on a Ray cluster; raises if a block of them failed, and keeps the others."""
    blocks = blocks_of(definition, missing, results.header, store_url)
    folders = [results.path.parent, *(EpisodeStore(store_url).folders if store_url else ())]
    jobs = run_jobs(run_block, blocks, Workers(ray_address=ray_address), folders=folders)
    with Progress("rollouts", len(missing)) as progress:
        for outcomes in results_of(jobs):
            for outcome in outcomes:
                results.keep(outcome)
                progress.advance()


def blocks_of(
    definition: StudyDefinition,
    missing: Sequence[PlannedRollout],
    header: StudyHeader,
    store_url: str | None,
) -> list[_Block]:
    """Rollouts by world, task and `_STARTS_IN_A_BLOCK` seeds."""
    by_place: dict[tuple[str, str, int], list[PlannedRollout]] = {}
    for one in missing:
        number = (one.seed - definition.first_seed) // _STARTS_IN_A_BLOCK
        by_place.setdefault((one.world, one.task, number), []).append(one)
    blocks = []
    for (world, task, _), rollouts in by_place.items():
        seeds = [one.seed for one in rollouts]
        changes: dict[str, object] = {
            "tasks": (task,),
            "first_seed": min(seeds),
            "num_starts": max(seeds) - min(seeds) + 1,
            "imagined": {n: one for n, one in definition.imagined.items() if n == world},
        }
        part = definition.model_copy(update=changes)
        blocks.append(_Block(part, tuple(rollouts), header, store_url))
    return blocks


def run_block(block: _Block) -> list[Outcome]:
    """Outcomes of the rollouts of a block, whose worlds are served on this machine."""
    outcomes: list[Outcome] = []
    with served_worlds(block.definition) as addresses:
        parts, _ = _parts(block.definition, addresses, block.store_url)
        run_rollouts(block.definition, block.rollouts, block.header, parts, outcomes.append)
    return outcomes


def _own_paths(definition: StudyDefinition) -> list[tuple[str, Path]]:
    return [(name, one.probe) for name, one in definition.imagined.items() if one.probe is not None]


def _own_probes(
    definition: StudyDefinition, probe: SuccessClassifier
) -> dict[str, SuccessClassifier]:
    """Success classifiers of single worlds, by world, that fit the study's."""
    own: dict[str, SuccessClassifier] = {}
    for name, path in _own_paths(definition):
        own[name] = SuccessClassifier.load(path)
        command_line.instructions_for(definition.tasks, own[name].metadata.settings["instructions"])
        size_px, expected_px = own[name].shape.image_size_px, probe.shape.image_size_px
        if size_px != expected_px:
            raise InvalidInputError(
                f"world {name!r}: its success classifier {path} sees images of {size_px} px, "
                f"expected {expected_px} as the study's; train both with the same --image-px"
            )
    return own


def _finish(results: StudyResults, json_path: Path | None) -> int:
    figures = write_reports(results, json_path)
    write_pictures(results)
    command_line.print_scores(figures)
    command_line.print_failures(figures, results.path)
    print(f"\nreport: {results.path.with_name(REPORT_FILE)}")
    return command_line.EXIT_FAILED if figures["failures"] else 0


@contextmanager
def served_worlds(definition: StudyDefinition) -> Iterator[dict[str, ServedWorld]]:
    """Addresses of all worlds by name; those without a URL are served until the block ends.

    Raises UnavailableError if a process could not serve its world (its messages are above), and
    InvalidInputError for a checkpoint that cannot be served, or a key's variable that is not set.
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
            name: ServedWorld(**served[name]) if name in served else _address(name, choice)
            for name, choice in choices.items()
        }


def _address(name: str, choice: WorldChoice) -> ServedWorld:
    key, variable = None, choice.api_key_variable
    if variable is not None and (key := os.environ.get(variable)) is None:
        raise InvalidInputError(
            f"world {name!r}: its API key is expected in the variable {variable}, which is not set"
        )
    return ServedWorld(url=str(choice.url), world=str(choice.world), api_key=key)


def connect(addresses: Mapping[str, ServedWorld], connections: ExitStack) -> StudyWorlds:
    """Open connections to all worlds and ask what they are."""
    worlds = {name: command_line.opened(one, connections) for name, one in addresses.items()}
    return StudyWorlds.ask(worlds.pop(REAL), worlds)


def refuse_training_seeds(definition: StudyDefinition) -> None:
    """Refuse starts whose task and seed a world model was trained on, by ConflictError.

    Raises NotFoundError if a checkpoint is missing.
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
    """Raise ConflictError for starts whose task and seed a state model was trained on.

    Content digests miss them where image size or simulator changed since.
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

    Raises UnknownNameError for an unknown script or task.
    """
    return ReplayPolicy(
        {
            (task, seed): scripted_actions(stage_of(task, "robot"), seed, script)
            for task in tasks
            for seed in seeds
        }
    )
