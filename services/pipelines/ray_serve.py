"""Ray Serve applications of the world model and the twin, for replicas on many machines.

serve run services.pipelines.ray_serve:world_model num_replicas=4

Their settings are the variables of `dextouch serve` and `dextouch twin serve`. Replicas are chosen
by the header `x-session-id`, in which `RolloutClient` sends the rollout's id.
"""

from collections.abc import Callable, Mapping
from functools import partial

from fastapi import FastAPI
from ray import serve
from ray.serve.config import RequestRouterConfig

from dextouch.errors import InvalidInputError
from dextouch.worlds import WorldServiceSettings, create_serving_app

ROUTER = "ray.serve.experimental.consistent_hash_router:ConsistentHashRouter"
# More than a world's batch; Ray's default of 5 would leave batches almost empty.
MAX_ONGOING_REQUESTS = 100


def world_model(arguments: Mapping[str, str]) -> serve.Application:
    """The world model; `num_replicas` of it."""
    from services.world_model.command_line import open_by_digest, open_worlds
    from services.world_model.settings import WorldModelSettings

    settings = WorldModelSettings()
    worlds = partial(open_worlds, settings)
    reopen = partial(open_by_digest, settings)
    create_app = partial(create_serving_app, worlds, settings, "world_model", reopen)
    return application(create_app, settings, num_replicas=int(arguments.get("num_replicas", 2)))


def twin(arguments: Mapping[str, str]) -> serve.Application:
    """The twin and its baseline; `num_replicas` of them."""
    from services.twin.settings import TwinServiceSettings
    from services.twin.world import twin_worlds

    settings = TwinServiceSettings()
    worlds = partial(twin_worlds, settings.scene)
    create_app = partial(create_serving_app, worlds, settings, "twin")
    return application(create_app, settings, num_replicas=int(arguments.get("num_replicas", 2)))


def application(
    create_app: Callable[[], FastAPI], settings: WorldServiceSettings, *, num_replicas: int
) -> serve.Application:
    """A service of worlds, created in each replica, as a deployment that shares its rollouts.

    Raises InvalidInputError for state in memory, which each replica would have for itself.
    """
    if settings.state_url == "memory://":
        raise InvalidInputError(
            "state_url: got memory://, which each replica would have for itself, expected "
            "redis://HOST:PORT/DB"
        )
    replica = serve.deployment(
        # Ray takes functions, but no partial ones.
        serve.ingress(lambda: create_app())(),  # noqa: PLW0108
        name="worlds",
        num_replicas=num_replicas,
        max_ongoing_requests=MAX_ONGOING_REQUESTS,
        request_router_config=RequestRouterConfig(request_router_class=ROUTER),
    )
    return replica.bind()
