"""Record twin episodes for training and testing networks (`dextouch train data`)."""

import hashlib
import json
import os
import re
import shlex
import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final

import numpy as np

from dextouch.clients import Policy, PolicyStart
from dextouch.command_line import write_result
from dextouch.episodes import EpisodeStore
from dextouch.errors import ConflictError, DeviceError, InvalidInputError, UnknownNameError
from dextouch.jobs import Workers, run_jobs
from dextouch.schemas import RolloutStart, SceneObjects
from dextouch.serving import configure_logging
from services.evaluation.policies.user_policies import PolicySource, action_chunk, ask
from services.evaluation.progress import Progress
from services.pipelines.parsers import training_data_parser
from services.twin.cameras import Markers, marked_objects
from services.twin.demonstrators import NUM_GRID_STEPS
from services.twin.episodes import TruthEpisode, episode_id, record, write_episode
from services.twin.names import CAMERAS as ALL_CAMERAS
from services.twin.names import DOMAINS, Domain, StreamChoice, TakePath
from services.twin.scene import Sizes, object_boxes_m
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.take_options import MIXES, Mix, PlayedActions, TakeOptions, options_of
from services.twin.tasks import EVALUATED, named_tasks
from services.twin.world import TwinWorld

CAMERAS = ("camera_head",)
MAX_LABEL = 32  # chosen: names stay recognizable in ids
# Markers of 3 cm are 20 px wide in such images.
_MARKED_IMAGE_PX: Final = 400
_VARIED_DRAW, _SIZES_DRAW = 103, 104


@dataclass(frozen=True)
class Scope:
    """Tasks, domains, images and streams to record.

    In a share `varied` of the scenes, colours, light and head camera are drawn anew, in a share
    `resized` the sizes of the objects. Images are recorded at the grid steps (15 Hz) that are
    multiples of `image_every`, and at the last three. Without a `path` robots are written directly
    and humans by devices: the actions of a human take that is written directly are the joint angles
    of a human hand.
    """

    tasks: tuple[str, ...] = EVALUATED
    domains: tuple[Domain, ...] = ("robot",)
    image_every: int = 1
    streams: StreamChoice = "training"
    path: TakePath | None = None
    varied: float = 0.0
    resized: float = 0.0
    cameras: tuple[str, ...] = CAMERAS

    def path_of(self, domain: Domain) -> TakePath:
        """The path of the takes of a domain."""
        return self.path or ("devices" if domain == "human" else "direct")

    def __post_init__(self) -> None:
        if not (0 <= self.varied <= 1 and 0 <= self.resized <= 1):
            raise InvalidInputError(
                f"training data: got a share of {self.varied} varied and {self.resized} resized "
                "takes, expected 0 … 1"
            )
        for domain in self.domains:
            if domain not in DOMAINS:
                raise UnknownNameError("domain", domain, list(DOMAINS))


@dataclass(frozen=True)
class PolicyChoice:
    """A policy's address, as in `dextouch evaluate`, and its factory's arguments as JSON."""

    address: str
    arguments: str = "{}"

    @classmethod
    def parse(cls, address: str, arguments: Mapping[str, Any]) -> "PolicyChoice":
        """Validate the address and create a choice."""
        PolicySource.parse(address)
        return cls(address, json.dumps(arguments, sort_keys=True))

    @property
    def label(self) -> str:
        """Name used in episode ids; it depends on the address and the arguments."""
        name = re.sub(r"[^a-z0-9]+", "_", PolicySource.parse(self.address).name.lower()).strip("_")
        digest = hashlib.sha256(f"{self.address} {self.arguments}".encode()).hexdigest()
        return f"{name[:MAX_LABEL]}_{digest[:6]}"


@dataclass(frozen=True)
class Order:
    """One episode to record, in any process."""

    task: str
    domain: Domain
    seed: int
    options: TakeOptions
    store: str
    policy: PolicyChoice | None = None
    path: TakePath = "direct"

    @property
    def episode_id(self) -> str:
        """Id of the episode, known before it is recorded."""
        played = None if self.policy is None else self.policy.label
        name = episode_id(self.task, self.domain, self.seed, self.options, played=played)
        return name if self.path == "direct" else f"{name}-{self.path}"


@dataclass(frozen=True)
class Answer:
    """Result of an order: success, None if another process was faster, or a refusal."""

    episode_id: str
    success: bool | None = None
    refusal: str | None = None


@lru_cache(maxsize=12)
def stage_of(task: str, domain: Domain) -> Stage:
    """The stage of a task, compiled once per process."""
    return Stage(task, domain, TwinSettings())


@lru_cache(maxsize=12)
def marked_stage(task: str, domain: Domain) -> tuple[Stage, SceneObjects]:
    """A stage with markers on its objects and a camera that can read them, and their places."""
    # Needs OpenCV, which recording without a station does not.
    from services.alignment.markers import cells_of_markers

    px = _MARKED_IMAGE_PX
    stage = Stage(task, domain, TwinSettings(image_height_px=px, image_width_px=px))
    scene = stage.simulation.scene
    objects = marked_objects(
        task, scene.object_names, object_boxes_m(scene), scene.bodies.are_fixed
    )
    stage.rig.markers = Markers(objects, cells_of_markers(objects))
    return stage, objects


@lru_cache(maxsize=1)
def _world() -> TwinWorld:
    return TwinWorld(TwinSettings(cameras=CAMERAS))


@lru_cache(maxsize=2)
def _policy(choice: PolicyChoice) -> Policy:
    return PolicySource.parse(choice.address).load(json.loads(choice.arguments))


def _played_by(choice: PolicyChoice, stage: Stage, seed: int) -> PlayedActions:
    """Actions of a policy in the twin, which is deterministic: their episode is the rollout."""
    world, policy, task = _world(), _policy(choice), stage.task
    start = RolloutStart(task=task.name, seed=seed, instruction=task.instruction)
    begun = world.reset(start)
    state, seen = begun.state, begun.observation
    where = f"policy {choice.address!r}, task {task.name!r}, seed {seed}"
    policy_start = PolicyStart(task.name, task.instruction, seed, begun.anchor, begun.K_head)
    ask(policy.reset, policy_start, where=f"{where}: reset")
    # Row 0 is the start.
    rows = [seen.action_reached[:1]]
    while (left := NUM_GRID_STEPS - sum(map(len, rows))) > 0:
        chunk = action_chunk(ask(policy.act, seen, where=f"{where}: act"), world.description,
                             where=f"{where}: act")[:left]  # fmt: skip
        stepped = world.step(state, chunk, seed=0)
        state, seen = stepped.state, stepped.observation
        rows.append(chunk)
    command = (
        f"dextouch train data --policy {shlex.quote(choice.address)} --policy-arguments "
        f"{shlex.quote(choice.arguments)} --tasks {task.name} --first {seed} --count 1"
    )
    return PlayedActions(choice.label, np.concatenate(rows), command)


def _recorded(order: Order, options: TakeOptions) -> TruthEpisode:
    stage = stage_of(order.task, order.domain)
    played = None if order.policy is None else _played_by(order.policy, stage, order.seed)
    return record(stage, order.seed, options, played=played)


def _written(order: Order) -> TruthEpisode:
    """Record a take, and write it as it is, or what a station and alignment make of it."""
    if order.path == "direct":
        episode = _recorded(order, order.options)
        write_episode(EpisodeStore(order.store), episode)
        return episode
    # Loads the compiled solver of retargeting.
    from services.pipelines.mock_takes import device_options, write_by_station

    # By devices with the twin's labels; by a station without them, markers on objects are measured.
    options, objects = device_options(order.options), None
    if order.path == "station":
        stage, objects = marked_stage(order.task, order.domain)
        episode = record(stage, order.seed, replace(options, image_every=1))
    else:
        episode = _recorded(order, options)
    store, name = EpisodeStore(order.store), order.episode_id
    write_by_station(store, episode, objects, episode_id=name, options=order.options)
    return episode


def make_episode(order: Order) -> Answer:
    """Record one episode and write it to its store."""
    try:
        episode = _written(order)
    except ConflictError:
        return Answer(order.episode_id)
    except (InvalidInputError, DeviceError) as error:
        return Answer(order.episode_id, refusal=error.message)
    return Answer(order.episode_id, bool(episode.attributes.success))


def make_training_data(
    store: str,
    seeds: range,
    mix: Mix,
    *,
    workers: Workers | None = None,
    scope: Scope = Scope(),
    policy: PolicyChoice | None = None,
) -> dict[str, int]:
    """Record one episode per seed, task and domain; existing episodes are kept.

    By default, each core records one at a time. A policy acts instead of the scripts of `mix`.
    Returns numbers of episodes `made`, `kept` and `refused` (the physics diverged, the policy
    failed, or the take could not be aligned), and of those made, how many `succeeded`. Raises
    InvalidInputError without seeds, tasks or domains, or for a policy with human hands.
    """
    if not seeds or not scope.tasks or not scope.domains:
        raise InvalidInputError(
            f"training data: got seeds {seeds}, tasks {scope.tasks} and domains {scope.domains}, "
            "expected at least one of each"
        )
    if policy is not None and scope.path == "station":
        raise InvalidInputError("training data: got a policy and --path station; it plays scripts")
    if policy is not None and scope.domains != ("robot",):
        raise InvalidInputError("training data: got a policy for human hands; it moves the robot's")
    target = EpisodeStore(store)
    # Remove partial episodes of killed runs; those of running writers are not touched.
    target.sweep()
    present, orders = set(target.list()), _orders(store, seeds, mix, scope, policy)
    missing = [order for order in orders if order.episode_id not in present]
    counts = {"made": 0, "kept": len(orders) - len(missing), "succeeded": 0, "refused": 0}
    started_s = time.monotonic()
    with Progress("twin episodes", len(missing)) as progress:
        jobs = run_jobs(
            make_episode,
            missing,
            workers or Workers(os.cpu_count() or 1),
            prepare=log_warnings,
            folders=target.folders,
        )
        for done, job in enumerate(jobs, start=1):
            answer = job.value or Answer(job.item.episode_id, refusal=str(job.error))
            if answer.refusal is not None:
                counts["refused"] += 1
                print(f"{answer.episode_id}: {answer.refusal}")
            elif answer.success is None:
                counts["kept"] += 1
            else:
                counts["made"] += 1
                counts["succeeded"] += answer.success
            each_s = (time.monotonic() - started_s) / done
            progress.advance(
                episodes_per_s=1 / each_s, minutes_left=each_s * (len(missing) - done) / 60
            )
    return counts


def _orders(
    store: str, seeds: range, mix: Mix, scope: Scope, policy: PolicyChoice | None
) -> list[Order]:
    orders = []
    for seed in seeds:
        for task in scope.tasks:
            made = TakeOptions() if policy is not None else options_of(task, seed, mix)
            options = replace(
                made, images=scope.cameras, image_every=scope.image_every, streams=scope.streams,
                varied=bool(np.random.default_rng([seed, _VARIED_DRAW]).random() < scope.varied),
                sizes=_sizes(task, seed, scope),
            )  # fmt: skip
            orders += [
                Order(task, domain, seed, options, store, policy, scope.path_of(domain))
                for domain in scope.domains
            ]
    return orders


def _sizes(task: str, seed: int, scope: Scope) -> Sizes:
    draw = np.random.default_rng([seed, zlib.crc32(task.encode()), _SIZES_DRAW])
    return Sizes.drawn(draw) if draw.random() < scope.resized else Sizes()


def log_warnings() -> None:
    """Log no more than warnings: a take has a dozen events."""
    configure_logging(service="train_data", log_format="auto", level="warning")


def main(argv: Sequence[str]) -> int:
    """Run `dextouch train data`; returns 1 if an episode could not be recorded."""
    arguments = training_data_parser().parse_args(list(argv))
    seeds = range(arguments.first, arguments.first + max(0, arguments.count))
    mix = MIXES[arguments.mix].changed(miss=arguments.miss_fraction, still=arguments.still_fraction)
    tasks = named_tasks(arguments.tasks)
    cameras = ALL_CAMERAS if arguments.wrist_cameras else CAMERAS
    scope = Scope(tasks, arguments.domains, arguments.images, arguments.streams, arguments.path,
                  arguments.varied, arguments.resized, cameras)  # fmt: skip
    log_warnings()
    policy = arguments.policy and PolicyChoice.parse(arguments.policy, arguments.policy_arguments)
    counts = make_training_data(
        arguments.store,
        seeds,
        mix,
        workers=Workers(arguments.jobs, arguments.ray),
        scope=scope,
        policy=policy,
    )
    print(", ".join(f"{count} {name}" for name, count in counts.items()))
    write_result(arguments.json, counts)
    return 1 if counts["refused"] else 0
