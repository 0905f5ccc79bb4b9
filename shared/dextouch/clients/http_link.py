"""Minimal HTTP client on the standard library that raises services' problems as our errors.

It uses http.client, which needs no dependency and takes a third of the time of httpx on large
bodies.
"""

import http.client
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from urllib.parse import urlsplit

from pydantic import ValidationError

from dextouch.errors import InvalidInputError, UnavailableError
from dextouch.schemas import CLASS_OF_STATUS, Problem, error_from_problem

# Pauses before each new attempt after a lost connection.
RETRY_PAUSES_S = (0.05, 0.2, 0.8)


@dataclass(frozen=True)
class Reply:
    """A successful response."""

    status: int
    headers: Mapping[str, str]
    body: bytes


class HttpLink:
    """One keep-alive connection; not thread-safe."""

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        timeout_s: float = 60.0,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        parts = urlsplit(url)
        if parts.scheme not in {"http", "https"} or not parts.hostname:
            raise InvalidInputError(f"address: got {url!r}, expected http(s)://HOST:PORT")
        kind = (
            http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        )
        self._connection = kind(parts.hostname, parts.port, timeout=timeout_s)
        self._where = f"{parts.scheme}://{parts.netloc.rsplit('@', 1)[-1]}"
        self._prefix = parts.path.rstrip("/")
        self._headers = {} if api_key is None else {"Authorization": f"Bearer {api_key}"}
        self._pause = pause

    def request(
        self,
        method: str,
        path: str,
        *,
        body: bytes | None = None,
        content_type: str = "application/json",
        accept: str = "application/json",
    ) -> Reply:
        """Send a request, again after a lost connection: every request must be idempotent.

        Raises:
            UnavailableError: no response after all attempts.
            DexTouchError: the problem that the service reports, as its own class.
        """
        headers = self._headers | {"Accept": accept}
        if body is not None:
            headers["Content-Type"] = content_type
        problem: Exception | None = None
        for pause_s in (0.0, *RETRY_PAUSES_S):
            if pause_s:
                self._pause(pause_s)
            try:
                self._connection.request(method, self._prefix + path, body=body, headers=headers)
                answer = self._connection.getresponse()
                reply = Reply(answer.status, dict(answer.headers.items()), answer.read())
            except (OSError, http.client.HTTPException) as error:
                self._connection.close()
                problem = error
                continue
            return _checked(reply, f"{method} {self._where}{path}")
        raise UnavailableError(
            f"{method} {self._where}{path}: no answer in {1 + len(RETRY_PAUSES_S)} attempts, last: "
            f"{type(problem).__name__}: {problem}; is the service running?"
        ) from problem

    def close(self) -> None:
        """Close the connection; the next request opens it again."""
        self._connection.close()


def _checked(reply: Reply, where: str) -> Reply:
    if reply.status < 300:
        return reply
    try:
        problem = Problem.model_validate_json(reply.body)
    except ValidationError as error:
        kind = CLASS_OF_STATUS.get(reply.status, UnavailableError)
        raise kind(
            f"{where}: got status {reply.status} without a problem+json body; "
            "is a DexTouch service listening there?"
        ) from error
    raise error_from_problem(problem)
