"""Score policies in a world model from the first observations of recorded takes.

For labs whose real world is a robot: takes are robot episodes with an outcome, of a station or of
the twin. Their own actions are replayed in the world model first; how well its verdicts match the
outcomes says how far the policies' scores can be trusted. Takes that the model was trained on are
refused.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch

from dextouch.clients import Policy, RolloutClient
from dextouch.command_line import CommandParser, add_json, write_result
from dextouch.episodes import SPLITS, EpisodeStore
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.serving import configure_logging
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.cli.generate import refuse_trained_episodes
from services.cli.imagined_data import WORLD, positive
from services.cli.servers import served
from services.cli.training_data import comma_separated
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.policies.hold import HoldPolicy
from services.evaluation.policies.outside import PolicySource
from services.evaluation.recorded_takes import REPLAY, read_takes, score_lines, score_recorded
from services.evaluation.settings import DEFAULT_PROBE
from services.evaluation.study_worlds import WorldAddress
from services.evaluation.success_probe import SuccessProbe
from services.world_model.shipped_checkpoints import default_checkpoint
from services.world_model.world import open_world

EXIT_FAILED = 1
_EPILOG = """\
examples:
  dextouch evaluate recorded --episodes runs/takes --checkpoint runs/state.safetensors \\
    --probe runs/probe.safetensors --split A
  dextouch evaluate recorded --episodes runs/takes --policy mine=my_policy:MyPolicy \\
    --cloned cloned=runs/cloned.safetensors --json runs/scores.json
"""


def main(arguments: Sequence[str]) -> int:
    """Run `dextouch evaluate recorded`; returns 1 if a rollout failed."""
    options = _parser().parse_args(list(arguments))
    stores = [EpisodeStore(url) for url in options.episodes]
    splits = (options.split,) if options.split else ()
    takes = read_takes(stores, tasks=options.tasks, splits=splits, most=options.count)
    wanted = {take.episode_id for take in takes}
    for store in stores:
        own = sorted(wanted & set(store.list()))
        refuse_trained_episodes(store, own, options.checkpoint, command="evaluate recorded")
    policies = _policies(options)
    probe = SuccessProbe.load(options.probe)
    torch.set_num_threads(1)
    configure_logging(service="evaluate_recorded", log_format="auto", level="warning")
    app = create_world_app(
        {WORLD: open_world(options.checkpoint)}, WorldServiceSettings(), name="imagined"
    )
    with ExitStack() as stack:
        urls = stack.enter_context(served({"imagined": app}))
        client = stack.enter_context(RolloutClient(urls["imagined"]))
        (description,) = [one for one in client.worlds() if one.name == WORLD]
        scores = score_recorded(
            takes,
            policies,
            WorldAddress(client, WORLD),
            description,
            probe,
            trained_on={
                f"policy {name!r}": policy.metadata.training_starts
                for name, policy in policies.items()
                if isinstance(policy, BehaviourCloningPolicy)
            },
        )
    print("\n".join(score_lines(scores)))
    for failure in scores.failures:
        print(f"failed: {failure.policy}, take {failure.seed}: {failure.message}")
    about = {
        "checkpoint": options.checkpoint.name,
        "digest": description.digest,
        "probe": options.probe.name,
        "split": options.split,
    }
    write_result(options.json, {**about, **scores.to_report()}, allow_nan=False)
    return EXIT_FAILED if scores.failures else 0


def _policies(options: argparse.Namespace) -> dict[str, Policy]:
    """All requested policies by name.

    Raises:
        InvalidInputError: two policies of one name, or one that does not load.
        UnknownNameError: arguments of a policy that is not given.
    """
    policies: dict[str, Policy] = {}

    def add(name: str, policy: Policy) -> None:
        if name in policies or name == REPLAY:
            raise InvalidInputError(f"policies: {name!r} is given twice; rename one, NAME=…")
        policies[name] = policy

    sources = [PolicySource.parse(text) for text in options.policy]
    names = [source.name for source in sources]
    if unknown := sorted(set(options.policy_arguments) - set(names)):
        raise UnknownNameError("policy of --policy-arguments", unknown[0], names)
    for source in sources:
        add(source.name, source.load(options.policy_arguments.get(source.name, {})))
    for name, path in options.cloned:
        add(name, BehaviourCloningPolicy.load(path))
    if options.hold:
        add("hold", HoldPolicy())
    return policies


def _named_path(text: str) -> tuple[str, Path]:
    name, separator, path = text.partition("=")
    if not (separator and name and path):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected NAME=CHECKPOINT")
    return name, Path(path)


def _keywords(text: str) -> Mapping[str, Any]:
    try:
        found = json.loads(text)
    except json.JSONDecodeError as error:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a JSON object") from error
    if not isinstance(found, dict) or not all(isinstance(one, dict) for one in found.values()):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected an object of objects")
    return found


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(prog="dextouch evaluate recorded", description=__doc__, epilog=_EPILOG)
    add = parser.add_argument
    stores = "stores of the takes"
    add("--episodes", required=True, type=comma_separated, metavar="URL,…", help=stores)
    add("--tasks", type=comma_separated, default=(), metavar="A,B", help="default: all")
    add("--split", choices=SPLITS, help="only scenes of this split (default: all)")
    add("--count", type=positive, metavar="N", help="takes a task (default: all)")
    model = "world model (default: the package's)"
    add("--checkpoint", type=Path, default=default_checkpoint(), metavar="PATH", help=model)
    judge = "checkpoint of `dextouch train judge` (default: the package's)"
    add("--probe", type=Path, default=DEFAULT_PROBE, metavar="PATH", help=judge)
    own = "a policy of yours, [NAME=]MODULE:FACTORY; repeat for more"
    add("--policy", action="append", default=[], metavar="ADDRESS", help=own)
    keywords = "arguments of the factories, as a JSON object by policy name"
    add("--policy-arguments", type=_keywords, default={}, metavar="JSON", help=keywords)
    cloned = "a policy of `dextouch train policy`, NAME=CHECKPOINT; repeat for more"
    add("--cloned", action="append", type=_named_path, default=[], metavar="POLICY", help=cloned)
    add("--hold", action="store_true", help="also score a policy that holds still")
    add_json(parser)
    return parser
