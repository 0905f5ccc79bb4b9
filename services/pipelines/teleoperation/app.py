"""Service that commands robot hands, which follow tracked ones live (docs/teleoperation.md)."""

import asyncio
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from typing import Any, Final

import numpy as np
from fastapi import APIRouter, Depends, FastAPI
from prometheus_client import CollectorRegistry, Counter, Histogram
from starlette.websockets import WebSocket, WebSocketDisconnect

from dextouch.errors import (
    ConflictError,
    DexTouchError,
    InvalidInputError,
    NotFoundError,
    UnavailableError,
)
from dextouch.hands import NUM_KEYPOINTS
from dextouch.serving import (
    MAX_WEBSOCKET_BYTES,
    RequireScope,
    close_reason,
    create_service_app,
    serve,
)
from dextouch.streams import pack, unpack
from dextouch.tactile.layout import Side
from services.acquisition.devices.kinds import load_calibration
from services.alignment.retargeting import warm_up
from services.pipelines.teleoperation.hand_follower import Command, HandFollower, HandSample
from services.pipelines.teleoperation.settings import TeleoperationSettings

SCOPE: Final = "teleop"
_REFUSED: Final = 1008  # policy violation (RFC 6455)
_FORMS: Final = ("start", "sample", "stop")
# Buckets around the period of 1/60 s.
LATENCY_S: Final = (0.001, 0.002, 0.003, 0.005, 0.007, 0.01, 0.015, 0.02, 0.05, 0.1)


class TeleoperationMetrics:
    """Prometheus metrics of commands and samples, by side."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self.latency = Histogram(
            "dextouch_teleoperation_latency_seconds",
            "From the arrival of a sample to the first command that follows it.",
            ["side"],
            buckets=LATENCY_S,
            registry=registry,
        )
        self.commands = Counter(
            "dextouch_teleoperation_commands_total",
            "Commands that were sent, by the status of the hand.",
            ["side", "status"],
            registry=registry,
        )
        self.refused = Counter(
            "dextouch_teleoperation_refused_samples_total",
            "Samples that were not followed, by reason.",
            ["side", "reason"],
            registry=registry,
        )
        self.late = Counter(
            "dextouch_teleoperation_late_commands_total",
            "Commands that were sent more than a period late.",
            ["side"],
            registry=registry,
        )


class _Control:
    def __init__(
        self, socket: WebSocket, side: Side, follower: HandFollower, metrics: TeleoperationMetrics
    ) -> None:
        self._socket = socket
        self._side = side
        self._follower = follower
        self._metrics = metrics
        self._error: str | None = None

    async def run(self) -> None:
        """Answer the first message, which starts the hand; then command it until the end.

        Raises WebSocketDisconnect if the client is gone before it started, and InvalidInputError if
        the first message is no valid start.
        """
        form, value = _message(await self._socket.receive())
        if form != "start":
            raise InvalidInputError(f"message: got {form} first, expected start")
        self._start(value)
        hand, follower = self._follower.hand, self._follower
        described = {
            "name": hand.name,
            "joint_names": list(hand.joint_names),
            "lower_rad": hand.lower_rad.tolist(),
            "upper_rad": hand.upper_rad.tolist(),
            "rate_hz": 1 / follower.period_s,
            "limits": follower.limits.model_dump(),
        }
        await self._socket.send_bytes(pack({"hand": described}, {}))
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._send_commands())
                group.create_task(self._receive_messages())
        except* WebSocketDisconnect:
            pass

    async def _receive_messages(self) -> None:
        while True:
            message = await self._socket.receive()
            received_s = time.monotonic()
            try:
                form, value = _message(message)
                if form == "sample":
                    self._follower.receive(value, received_s)
                elif form == "stop":
                    self._follower.stop()
                else:
                    self._start(value)
                if self._follower.can_check:
                    await asyncio.to_thread(self._follower.check_person)
            except DexTouchError as error:
                self._error = error.message

    def _start(self, joints_rad: dict[str, float]) -> None:
        names = self._follower.hand.joint_names
        if set(joints_rad) != set(names):
            wrong = ", ".join(sorted(set(joints_rad) ^ set(names)))
            raise InvalidInputError(
                f"start: joints missing or unknown: {wrong}; expected an angle of each joint of "
                f"the {self._side} hand, measured by the robot: {', '.join(names)}"
            )
        self._follower.start(np.array([joints_rad[name] for name in names], dtype=np.float64))

    async def _send_commands(self) -> None:
        """Send a command a period; after a late one the next is due a period later, not at once."""
        period_s = self._follower.period_s
        due_s = time.monotonic()
        counted = self._follower.refused.copy()
        while True:
            late_s = time.monotonic() - due_s
            if late_s > period_s:
                self._metrics.late.labels(self._side).inc()
                due_s += late_s
            command = self._follower.command(time.monotonic())
            await self._socket.send_bytes(self._packed(command))
            if command.received_s is not None:
                latency_s = time.monotonic() - command.received_s
                self._metrics.latency.labels(self._side).observe(latency_s)
            self._metrics.commands.labels(self._side, command.status.value).inc()
            refused = self._follower.refused.copy()
            for reason, count in (refused - counted).items():
                self._metrics.refused.labels(self._side, reason).inc(count)
            counted = refused
            due_s += period_s
            await asyncio.sleep(due_s - time.monotonic())

    def _packed(self, command: Command) -> bytes:
        hand = self._follower.hand
        fingers = zip(hand.fingers, command.finger_status, command.tip_error_m, strict=True)
        received_s = command.received_s
        fields = {
            "step": command.step,
            "status": command.status.value,
            "joints_rad": dict(zip(hand.joint_names, command.joints_rad.tolist(), strict=True)),
            "t_device_ns": command.t_device_ns,
            "age_s": command.age_s,
            "latency_s": None if received_s is None else time.monotonic() - received_s,
            "fingers": {
                finger.chain: {"status": status.name.lower(), "tip_error_m": float(error_m)}
                for finger, status, error_m in fingers
            },
            "lag_rad": command.lag_rad,
            "at_limits": command.at_limits,
            "stopped_fingers": list(command.stopped_fingers),
            "refused": dict(self._follower.refused),
            "error": self._error,
        }
        self._error = None
        return pack(fields, {})


def _message(received: Any) -> tuple[str, Any]:  # noqa: ANN401 - of ASGI
    """Name and content of a message: angles by joint of a start, a sample, or nothing of a stop.

    Raises WebSocketDisconnect if the client is gone, and InvalidInputError for anything else.
    """
    if received["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(received.get("code", 1005))
    if received.get("bytes") is None:
        raise InvalidInputError("message: got text, expected msgpack in a binary message")
    fields, arrays = unpack(received["bytes"], max_bytes=MAX_WEBSOCKET_BYTES)
    if len(fields) != 1 or not set(fields) <= set(_FORMS):
        raise InvalidInputError(
            f"message: got the fields {', '.join(sorted(fields)) or 'none'}, expected one of "
            f"{', '.join(_FORMS)}"
        )
    [(form, value)] = fields.items()
    if form == "start":
        is_map = isinstance(value, dict) and all(isinstance(name, str) for name in value)
        angles = value.values() if is_map else ["none"]
        if not all(isinstance(one, int | float) and not isinstance(one, bool) for one in angles):
            raise InvalidInputError("start: expected a map of joint names to angles in rad")
    if form == "sample":
        return form, _sample(value, arrays.get("keypoints_m"))
    return form, value


def _sample(value: object, keypoints_m: np.ndarray | None) -> HandSample:
    stamp = value.get("t_device_ns") if isinstance(value, dict) else None
    if not isinstance(stamp, int) or isinstance(stamp, bool) or not 0 <= stamp < 2**63:
        raise InvalidInputError(
            f"sample: got t_device_ns {stamp!r}, expected the tracker's time in nanoseconds"
        )
    shape = (NUM_KEYPOINTS, 3)
    if keypoints_m is None or keypoints_m.shape != shape or keypoints_m.dtype.kind != "f":
        got = "none" if keypoints_m is None else f"{keypoints_m.dtype} {list(keypoints_m.shape)}"
        raise InvalidInputError(
            f"sample: got keypoints_m {got}, expected float32 or float64 [{NUM_KEYPOINTS}, 3]"
        )
    return HandSample(keypoints_m.astype(np.float64), stamp)


def teleoperation_router(settings: TeleoperationSettings) -> APIRouter:
    """Routes of `/v1/teleop/{side}`; raises InvalidInputError if the calibration cannot be read."""
    router = APIRouter(prefix="/v1/teleop", tags=["teleoperation"])
    calibration = load_calibration(settings.calibration)
    # Name of the controller's key, and the hand that it controls.
    controlled: dict[Side, tuple[str, HandFollower]] = {}

    async def control_as(name: str, socket: WebSocket, side: Side) -> None:
        if not socket.app.state.is_warm.is_set():
            raise UnavailableError("the solver is being compiled; wait until /readyz says ready")
        if side in controlled:
            raise ConflictError(
                f"the {side} hand is controlled by {controlled[side][0]!r}; close that "
                "connection first"
            )
        follower = HandFollower(side, settings.limits, settings.rate_hz, calibration)
        controlled[side] = name, follower
        try:
            await _Control(socket, side, follower, socket.app.state.teleoperation).run()
        finally:
            del controlled[side]

    @router.websocket("/{side}")
    async def control(socket: WebSocket, side: Side) -> None:
        try:
            name = socket.app.state.access.check(socket.headers.get("authorization"), SCOPE)
        except DexTouchError as error:
            await socket.close(_REFUSED, close_reason(error.message))
            return
        # Clients learn the reason of a close only of accepted connections.
        await socket.accept()
        with suppress(WebSocketDisconnect):
            try:
                await control_as(name, socket, side)
            except DexTouchError as error:
                await socket.close(_REFUSED, close_reason(error.message))

    @router.post("/{side}/stop", status_code=204, dependencies=[Depends(RequireScope(SCOPE))])
    async def stop_hand(side: Side) -> None:
        """Stop a hand that another program controls; it holds until that program starts it."""
        if side not in controlled:
            raise NotFoundError(f"nobody controls the {side} hand: there is nothing to stop")
        controlled[side][1].stop()

    return router


def create_app(settings: TeleoperationSettings) -> FastAPI:
    """Create the service; it is ready once the solver is compiled."""
    is_warm = asyncio.Event()

    async def compile_solver() -> None:
        await asyncio.to_thread(warm_up)
        is_warm.set()

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        async with asyncio.TaskGroup() as group:
            group.create_task(compile_solver())
            yield

    async def readiness() -> Sequence[str]:
        return [] if is_warm.is_set() else ["solver"]

    app = create_service_app(
        name="teleoperation",
        settings=settings,
        routers=[teleoperation_router(settings)],
        lifespan=lifespan,
        readiness=readiness,
    )
    app.state.is_warm = is_warm
    app.state.teleoperation = TeleoperationMetrics(app.state.registry)
    return app


def main(argv: Sequence[str]) -> int:
    """Serve teleoperation until SIGINT or SIGTERM."""
    return serve("teleoperation", TeleoperationSettings, create_app, argv)
