"""Child process of the benchmark: teleoperation at two rates, and a loop that answers every sample.

Answers once with the URLs, then every request with the processor time so far.
"""

import asyncio
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from dextouch.serving import configure_logging, serve_parent
from dextouch.streams import pack, unpack
from services.alignment.retargeting import HandRetargeter, warm_up
from services.pipelines.servers import run_on_event_loop, served
from services.pipelines.teleoperation.app import create_app
from services.pipelines.teleoperation.settings import TeleoperationSettings

RATES_HZ = {"ours": 200.0, "ours at 60 Hz": 60.0}
NAIVE = "answer every sample"
MAX_BYTES = 2**16


async def answer_samples(connection: ServerConnection) -> None:
    """Retarget every sample at once and send what comes out."""
    retargeter = HandRetargeter("right")
    names = retargeter.hand.joint_names
    last_ns = None
    with suppress(ConnectionClosed):
        await connection.recv()
        await connection.send(pack({"hand": {"joint_names": list(names)}}, {}))
        while True:
            message = await connection.recv(decode=False)
            fields, arrays = unpack(message, max_bytes=MAX_BYTES)
            now_ns = fields["sample"]["t_device_ns"]
            since_s = 1 / 60 if last_ns is None else max(now_ns - last_ns, 1) * 1e-9
            joints = retargeter.step(arrays["keypoints_m"], since_s).joints_rad[0]
            last_ns = now_ns
            answer = {
                "joints_rad": dict(zip(names, joints.tolist(), strict=True)),
                "t_device_ns": now_ns,
            }
            await connection.send(pack(answer, {}))


@contextmanager
def naive_server() -> Iterator[str]:
    """The loop that answers every sample, in a thread."""
    started, stop, ports = threading.Event(), asyncio.Event(), []
    loops: list[asyncio.AbstractEventLoop] = []

    async def run() -> None:
        async with serve(answer_samples, "127.0.0.1", 0, compression=None) as server:
            loops.append(asyncio.get_running_loop())
            ports.append(next(iter(server.sockets)).getsockname()[1])
            started.set()
            await stop.wait()

    thread = threading.Thread(target=run_on_event_loop, args=(run(),), daemon=True)
    thread.start()
    started.wait()
    yield f"http://127.0.0.1:{ports[0]}"
    loops[0].call_soon_threadsafe(stop.set)
    thread.join()


def main() -> None:
    """Serve until standard input closes."""
    requests, answer = serve_parent(niceness=0)
    warm_up()
    configure_logging(service="bench", log_format="json", level="warning")
    apps = {
        name: create_app(TeleoperationSettings(rate_hz=rate_hz))
        for name, rate_hz in RATES_HZ.items()
    }
    with ExitStack() as stack:
        urls = stack.enter_context(served(apps))
        answer({**urls, NAIVE: stack.enter_context(naive_server())})
        for _ in requests:
            answer({"cpu_s": time.process_time()})


if __name__ == "__main__":
    main()
