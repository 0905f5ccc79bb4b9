"""Practice devices of a mock station: a second one below its own address, started when wanted."""

import asyncio
from collections.abc import Callable
from contextlib import AsyncExitStack
from typing import Final

from fastapi import APIRouter, Depends, FastAPI
from starlette.concurrency import run_in_threadpool
from starlette.types import Receive, Scope, Send

from dextouch.errors import ConflictError, NotFoundError
from dextouch.schemas import PracticeStatus
from dextouch.serving import RequireScope

PRACTICE_PATH: Final = "/practice"


class Practice:
    """An ASGI application that serves the practice station while there is one.

    Args:
        make: makes the application of the practice station; None where devices are real.
    """

    def __init__(self, make: Callable[[], FastAPI] | None) -> None:
        self._make = make
        self._lock = asyncio.Lock()
        self._running: AsyncExitStack | None = None
        self._app: FastAPI | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on.

        Raises:
            NotFoundError: the practice devices are off.
        """
        if self._app is None:
            raise NotFoundError("practice devices: they are off; POST /v1/practice/start first")
        await self._app(scope, receive, send)

    @property
    def status(self) -> PracticeStatus:
        """Whether the practice devices run."""
        if self._make is None:
            return PracticeStatus(state="unavailable")
        return PracticeStatus(state="off" if self._app is None else "on")

    async def start(self) -> PracticeStatus:
        """Start the devices, which takes seconds; nothing happens if they run.

        Raises:
            ConflictError: the station has real devices.
        """
        if self._make is None:
            raise ConflictError(
                "practice devices: this station has real devices; practise with "
                "`dextouch up --mock` in another data folder"
            )
        async with self._lock:
            if self._app is None:
                app = await run_in_threadpool(self._make)
                self._running = AsyncExitStack()
                await self._running.enter_async_context(app.router.lifespan_context(app))
                self._app = app
        return self.status

    async def stop(self) -> PracticeStatus:
        """Stop the devices; nothing happens if they do not run."""
        async with self._lock:
            self._app, running, self._running = None, self._running, None
            if running is not None:
                await running.aclose()
        return self.status

    def router(self) -> APIRouter:
        """Routes that start and stop it."""
        router = APIRouter(
            prefix="/v1/practice", tags=["station"], dependencies=[Depends(RequireScope("station"))]
        )

        @router.get("")
        async def get_practice() -> PracticeStatus:
            """Whether devices to practise calibration with run, below `/practice`."""
            return self.status

        @router.post("/start")
        async def start_practice() -> PracticeStatus:
            """Start the practice devices."""
            return await self.start()

        @router.post("/stop")
        async def stop_practice() -> PracticeStatus:
            """Stop the practice devices."""
            return await self.stop()

        return router
