"""Score policies from recorded first observations (`dextouch evaluate recorded`)."""

import argparse
from collections.abc import Sequence
from contextlib import ExitStack

import torch

from dextouch.clients import Policy, RolloutClient
from dextouch.command_line import write_result
from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.serving import configure_logging
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.evaluation.matched_starts import WorldAddress
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.policies.outside import PolicySource
from services.evaluation.policies.replay import HoldPolicy
from services.evaluation.recorded_takes import REPLAY, read_takes, score_lines, score_recorded
from services.evaluation.success_classifier import SuccessClassifier
from services.pipelines.generate import refuse_trained_episodes
from services.pipelines.imagined_data import WORLD
from services.pipelines.parsers import recorded_parser
from services.pipelines.servers import served
from services.world_model.world import open_world

EXIT_FAILED = 1


def main(arguments: Sequence[str]) -> int:
    """Run `dextouch evaluate recorded`; returns 1 if a rollout failed."""
    options = recorded_parser().parse_args(list(arguments))
    stores = [EpisodeStore(url) for url in options.episodes]
    splits = (options.split,) if options.split else ()
    takes = read_takes(stores, tasks=options.tasks, splits=splits, most=options.count)
    wanted = {take.episode_id for take in takes}
    for store in stores:
        own = sorted(wanted & set(store.list()))
        refuse_trained_episodes(store, own, options.checkpoint, command="evaluate recorded")
    policies = _policies(options)
    probe = SuccessClassifier.load(options.probe)
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
