"""Child process of the benchmark: rollouts of a world that computes nothing, and two echoes.

Answers once with the three URLs, and ends when its parent does.
"""

import threading

import numpy as np
from jaxtyping import Float64
from starlette.types import Receive, Scope, Send
from websockets.sync.server import ServerConnection, serve

from dextouch.hands.actions import IDENTITY_POSE_9D, POSE_SLICES, AnchorPoses, check_actions
from dextouch.schemas import (
    EVERYTHING,
    Observation,
    ReturnSelector,
    RolloutStart,
    WorldDescription,
)
from dextouch.serving import configure_logging, serve_parent
from dextouch.worlds import (
    StartedRollout,
    SteppedRollout,
    WorldServiceSettings,
    create_world_app,
)
from services.cli.servers import served

SIZE_PX = 64
MAX_STEPS = 16
CAMERA = "camera_head"


def resting_actions(num_steps: int) -> Float64[np.ndarray, "steps 67"]:
    """Actions that leave everything in its place."""
    rows = np.zeros((num_steps, 67))
    for part in POSE_SLICES:
        rows[:, part] = IDENTITY_POSE_9D
    return rows


class StillWorld:
    """Returns the same prepared observation for every chunk."""

    is_quick = True

    def __init__(self) -> None:
        self.description = WorldDescription(
            name="still",
            kind="model",
            digest="still",
            tasks=("rest",),
            cameras=(CAMERA,),
            image_height_px=SIZE_PX,
            image_width_px=SIZE_PX,
            model_rate_hz=15.0,
            action_kinds=("commanded",),
            starts_from=("task_seed",),
            max_chunk_steps=MAX_STEPS,
        )
        generator = np.random.default_rng(0)
        shape = (MAX_STEPS, SIZE_PX, SIZE_PX, 3)
        self._images = generator.integers(0, 255, shape, dtype=np.uint8)
        self._touch = generator.random((MAX_STEPS, 2, 320), dtype=np.float32)

    def reset(self, start: RolloutStart) -> StartedRollout[int]:
        """See World."""
        del start
        anchor = AnchorPoses(np.eye(4), np.eye(4), np.eye(4))
        return StartedRollout(0, self._seen(0, resting_actions(1)), anchor, np.eye(3))

    def step(
        self,
        state: int,
        actions: Float64[np.ndarray, "steps 67"],
        *,
        seed: int,
        selector: ReturnSelector = EVERYTHING,
    ) -> SteppedRollout[int]:
        """See World."""
        del seed
        seen = self._seen(state + 1, check_actions(actions)).selected(selector)
        return SteppedRollout(state + len(actions), seen)

    def snapshot(self, state: int) -> bytes:
        """See World."""
        return str(state).encode()

    def restore(self, data: bytes) -> int:
        """See World."""
        return int(data)

    def _seen(self, first_step: int, actions: np.ndarray) -> Observation:
        n = len(actions)
        return Observation(
            first_step=first_step,
            images={CAMERA: self._images[:n]},
            tactile_kpa=self._touch[:n],
            action_reached=actions,
            reached_is_measured=True,
        )


async def echo(scope: Scope, receive: Receive, send: Send) -> None:
    """ASGI application that reads a body and answers with as many bytes as the path says."""
    if scope["type"] != "http":
        return
    while (await receive()).get("more_body"):
        pass
    body = bytes(int(scope["path"].rsplit("/", 1)[1]))
    headers = [
        (b"content-type", b"application/msgpack"),
        (b"content-length", str(len(body)).encode()),
    ]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": body})


def echo_messages(connection: ServerConnection) -> None:
    """Answer every message with as many bytes as its first eight say."""
    for message in connection:
        head = message[:8] if isinstance(message, bytes) else b""
        connection.send(bytes(int.from_bytes(head, "little")))


def main() -> None:
    """Serve until standard input closes."""
    requests, answer = serve_parent(niceness=0)
    configure_logging(service="benchmark", log_format="auto", level="warning")
    app = create_world_app({"still": StillWorld()}, WorldServiceSettings())
    with (
        serve(echo_messages, "127.0.0.1", 0, compression=None) as sockets,
        served({"ours": app, "echo": echo}) as urls,  # type: ignore[dict-item]
    ):
        threading.Thread(target=sockets.serve_forever, daemon=True).start()
        port = sockets.socket.getsockname()[1]
        answer({**urls, "messages": f"ws://127.0.0.1:{port}"})
        for _ in requests:
            pass
        sockets.shutdown()


if __name__ == "__main__":
    main()
