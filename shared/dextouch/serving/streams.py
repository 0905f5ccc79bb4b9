"""Response whose length is not known when it begins, such as a download that is made on the way."""

from collections.abc import AsyncIterable, Awaitable, Callable, Iterable, Mapping

from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send


class StreamedResponse(StreamingResponse):
    """Bytes as they come; `on_end` is awaited once, also if the client leaves before the end.

    A failure on the way cuts the connection, so that no part is taken for the whole.
    """

    def __init__(
        self,
        content: Iterable[bytes] | AsyncIterable[bytes],
        status_code: int = 200,
        *,
        headers: Mapping[str, str],
        on_end: Callable[[], Awaitable[None]],
    ) -> None:
        super().__init__(content, status_code, headers)
        self._on_end = on_end

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            await self._on_end()
