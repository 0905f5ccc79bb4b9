"""Policies trained with LeRobot, from the folders of their checkpoints; needs the extra `lerobot`.

LeRobot asks for older packages than some of the services, so in an environment of its own

    python -m dextouch.clients.lerobot_policy outputs/train/…/pretrained_model --port 8000

serves the policy by openpi's protocol to `dextouch evaluate` (docs/policies.md).
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import copy
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from dextouch.clients.rollouts import PolicyStart
from dextouch.errors import DexTouchError, InvalidInputError, ShapeError
from dextouch.hands.actions import ACTION_DIM
from dextouch.schemas import Observation
from dextouch.streams import pack_openpi, unpack_openpi

# Features of exported datasets (docs/bridges.md).
STATE: Final = "observation.state"
TACTILE: Final = "observation.tactile"
IMAGES: Final = "observation.images."
MAX_REQUEST_BYTES: Final = 2**26
# What OpenPiPolicy names them.
SERVED_NAMES: Final = {
    "observation/image": IMAGES + "camera_head",
    "observation/state": STATE,
    "observation/tactile": TACTILE,
}


class LeRobotPolicy:
    """A LeRobot policy with its processors, which acts as in LeRobot's own control loop.

    `path` is the folder of its checkpoint (`pretrained_model`). It must have been trained on an
    export of episodes: its inputs are among `observation.state`, `observation.tactile` and
    `observation.images.CAMERA`, its actions have 67 numbers. `chunk_steps` must divide its
    `n_action_steps`: it is asked at the start of a chunk, when there is a new observation.

    Raises InvalidInputError for a policy that needs other inputs, or several observations at once,
    ShapeError for actions of another width.
    """

    uses_images = "last"

    def __init__(self, path: str, *, chunk_steps: int = 16) -> None:
        from lerobot.configs.policies import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors

        config = PreTrainedConfig.from_pretrained(path)
        _check(config, chunk_steps)
        self.images = {
            name: name.removeprefix(IMAGES)
            for name in config.input_features
            if name.startswith(IMAGES)
        }
        self._config, self._chunk_steps, self._instruction = config, chunk_steps, ""
        self._policy = get_policy_class(config.type).from_pretrained(path, config=config)
        self._before, self._after = make_pre_post_processors(
            config,
            pretrained_path=path,
            preprocessor_overrides={"device_processor": {"device": str(config.device)}},
        )

    def another(self) -> "LeRobotPolicy":
        """The same policy with a state of its own, for another rollout."""
        policy = copy(self._policy)
        # The copy shares the weights; resetting gives it a queue of its own.
        policy.reset()
        other = copy(self)
        other.__dict__["_policy"] = policy
        return other

    def reset(self, start: PolicyStart) -> None:
        """Forget planned actions; the instruction is the policy's `task`."""
        self._instruction = start.instruction
        self._policy.reset()

    def act(self, observation: Observation) -> Float64[np.ndarray, "steps 67"]:
        """The next `chunk_steps` actions, given the newest step."""
        seen = {name: observation.images[camera][-1] for name, camera in self.images.items()}
        seen |= {STATE: observation.action_reached[-1], TACTILE: observation.tactile_kpa[-1]}
        return self.act_on(seen, self._instruction)

    def act_on(
        self, seen: Mapping[str, np.ndarray], instruction: str
    ) -> Float64[np.ndarray, "steps 67"]:
        """The next `chunk_steps` actions, given one step by LeRobot's names, and the task."""
        from lerobot.utils.control_utils import predict_action
        from lerobot.utils.utils import get_safe_torch_device

        missing = [name for name in self._config.input_features if name not in seen]
        if missing:
            raise InvalidInputError(
                f"LeRobot policy: got no {', '.join(missing)}, expected all its inputs"
            )
        inputs = {
            name: np.array(seen[name], np.uint8 if name.startswith(IMAGES) else np.float32)
            for name in self._config.input_features
        }
        rows = [
            predict_action(
                inputs,
                self._policy,
                get_safe_torch_device(self._config.device),
                self._before,
                self._after,
                use_amp=self._config.use_amp,
                task=instruction,
            )
            for _ in range(self._chunk_steps)
        ]
        return np.concatenate([row.cpu().numpy() for row in rows]).astype(np.float64)


def _check(config: Any, chunk_steps: int) -> None:  # noqa: ANN401 - of the policy's own class
    known = (STATE, TACTILE, IMAGES)
    unknown = [name for name in config.input_features if not name.startswith(known)]
    if unknown:
        raise InvalidInputError(
            f"LeRobot policy: needs {', '.join(unknown)}, expected inputs among {STATE}, {TACTILE} "
            f"and {IMAGES}CAMERA; was it trained on an export of episodes?"
        )
    if getattr(config, "n_obs_steps", 1) != 1:
        raise InvalidInputError(
            f"LeRobot policy: needs {config.n_obs_steps} observations at once, expected 1"
        )
    num_planned = getattr(config, "n_action_steps", 1)
    if chunk_steps < 1 or num_planned % chunk_steps:
        raise InvalidInputError(
            f"chunk_steps: got {chunk_steps}, expected a divisor of the policy's n_action_steps, "
            f"{num_planned}, which its config.json says and may be lowered there"
        )
    got = [list(feature.shape) for feature in config.output_features.values()]
    if got != [[ACTION_DIM]]:
        raise ShapeError(f"LeRobot policy: got actions of shape {got}, expected [[{ACTION_DIM}]]")


def main(argv: Sequence[str]) -> int:
    """Serve a policy on loopback until it is interrupted; prints the address."""
    from websockets.sync.server import ServerConnection, serve

    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("path", help="folder of the checkpoint")
    parser.add_argument("--port", type=int, default=0, help="0 for any free one")
    parser.add_argument("--chunk-steps", type=int, default=16, help="actions of a response")
    options = parser.parse_args(argv)
    loaded = LeRobotPolicy(options.path, chunk_steps=options.chunk_steps)

    def answer(connection: ServerConnection) -> None:
        policy = loaded.another()
        connection.send(pack_openpi({"images": policy.images, "resets": True}))
        for message in connection:
            data = message.encode() if isinstance(message, str) else message
            request = unpack_openpi(data, max_bytes=MAX_REQUEST_BYTES)
            if request.get("reset"):
                policy = loaded.another()
                connection.send(pack_openpi({}))
                continue
            seen = {SERVED_NAMES.get(name, name): value for name, value in request.items()}
            try:
                actions = policy.act_on(seen, str(seen.pop("prompt", "")))
            except DexTouchError as error:
                connection.send(error.message)
                return
            connection.send(pack_openpi({"actions": actions}))

    # Without an origin: programs, not web pages.
    with (
        serve(
            answer,
            "127.0.0.1",
            options.port,
            origins=[None],
            compression=None,
            max_size=MAX_REQUEST_BYTES,
        ) as server,
        suppress(KeyboardInterrupt),
    ):
        sys.stdout.write(f"ws://127.0.0.1:{server.socket.getsockname()[1]}\n")
        sys.stdout.flush()
        server.serve_forever()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
