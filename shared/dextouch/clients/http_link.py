"""Minimal HTTP client on the standard library that raises services' problems as our errors.

It uses http.client, which needs no dependency and takes a third of httpx's time on large bodies.
"""

import http.client
import itertools
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any
from urllib.parse import SplitResult, urlsplit

from pydantic import ValidationError

from dextouch.errors import InvalidInputError, UnavailableError
from dextouch.schemas import CLASS_OF_STATUS, PROBLEM_MEDIA_TYPE, Problem, error_from_problem
from dextouch.tracing import trace_headers

# Pauses before each new attempt after a lost connection.
RETRY_PAUSES_S = (0.05, 0.2, 0.8)
# Before further ones, while there is patience.
LAST_PAUSE_S = 0.8


@dataclass(frozen=True)
class Reply:
    """A successful response."""

    status: int
    headers: Mapping[str, str]
    body: bytes


class _WholeRequests(http.client.HTTPConnection):
    """Sends the head of a request together with its body, which spares the server a wake-up."""

    _unsent: bytes = b""

    def request(self, *given: Any, **options: Any) -> None:  # noqa: ANN401 - as http.client
        self._unsent = b""
        super().request(*given, **options)
        unsent, self._unsent = self._unsent, b""
        super().send(unsent)

    def send(self, data: Any) -> None:  # noqa: ANN401 - as http.client
        self._unsent = data if not self._unsent else self._unsent + data


class _WholeHttpsRequests(_WholeRequests, http.client.HTTPSConnection):
    """As above, over TLS."""


def service_address(url: str, *, what: str = "address") -> SplitResult:
    """Parts of a service's URL; raises InvalidInputError, which begins with `what`."""
    # A port may be no number, or too large a one.
    with suppress(ValueError):
        parts = urlsplit(url)
        if parts.scheme in {"http", "https"} and parts.hostname and parts.port != 0:
            return parts
    raise InvalidInputError(f"{what}: got {url!r}, expected http(s)://HOST:PORT")


class HttpLink:
    """One keep-alive connection; not thread-safe."""

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        timeout_s: float = 60.0,
        patience_s: float = 0.0,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        parts = service_address(url)
        kind = _WholeHttpsRequests if parts.scheme == "https" else _WholeRequests
        self._connection = kind(parts.hostname or "", parts.port, timeout=timeout_s)
        self._where = f"{parts.scheme}://{parts.netloc.rsplit('@', 1)[-1]}"
        self._prefix = parts.path.rstrip("/")
        self._headers = {} if api_key is None else {"Authorization": f"Bearer {api_key.strip()}"}
        self._patience_s = patience_s
        self._pause = pause
        self._has_answered = False

    def request(
        self,
        method: str,
        path: str,
        *,
        body: bytes | None = None,
        content_type: str = "application/json",
        accept: str = "application/json",
        headers: Mapping[str, str] | None = None,
    ) -> Reply:
        """Send a request, again after a lost connection: every request must be idempotent.

        A service that has ever responded may be away for `patience_s`: until then the request is
        also repeated after responses with `Retry-After`, not before the time it says, and after
        errors of a proxy.

        Raises:
            UnavailableError: no response after all attempts.
            DexTouchError: the problem that the service reports, as its own class.
        """
        sent = {**self._headers, **(headers or {}), "Accept": accept, **trace_headers()}
        if body is not None:
            sent["Content-Type"] = content_type
        began_s, paused_s = time.monotonic(), 0.0
        problem: Reply | OSError | http.client.HTTPException
        pauses_s = itertools.chain(RETRY_PAUSES_S, itertools.repeat(LAST_PAUSE_S))
        for attempt, pause_s in enumerate(pauses_s):
            try:
                self._connection.request(method, self._prefix + path, body=body, headers=sent)
                answer = self._connection.getresponse()
                reply = Reply(answer.status, dict(answer.headers.items()), answer.read())
            except (OSError, http.client.HTTPException) as error:
                self._connection.close()
                problem = error
                is_over = attempt >= len(RETRY_PAUSES_S)
            else:
                self._has_answered = True
                busy_s = _busy_s(answer)
                if busy_s is None:
                    return _checked(reply, f"{method} {self._where}{path}")
                problem, is_over = reply, True
                pause_s = max(pause_s, busy_s)  # noqa: PLW2901 - as asked for
            gone_s = pause_s + max(paused_s, time.monotonic() - began_s)
            if is_over and gone_s > (self._patience_s if self._has_answered else 0.0):
                break
            self._pause(pause_s)
            paused_s += pause_s
        if isinstance(problem, Reply):
            return _checked(problem, f"{method} {self._where}{path}")
        # Later requests do not wait as long, until it responds again.
        self._has_answered = False
        raise UnavailableError(
            f"{method} {self._where}{path}: no answer in {1 + attempt} attempts, last: "
            f"{type(problem).__name__}: {problem}; is the service running?"
        ) from problem

    def close(self) -> None:
        """Close the connection; the next request opens it again."""
        self._connection.close()


def _busy_s(answer: http.client.HTTPResponse) -> float | None:
    """How long to wait where the service, or a proxy that has no worker, asks for it, else None."""
    if answer.status < 400:
        return None
    # A date counts as no time.
    retry_after = answer.getheader("Retry-After")
    if retry_after is not None:
        return float(retry_after) if retry_after.isdecimal() else 0.0
    # Of services every refusal has a problem; Ray's proxy gives 500 where a replica died.
    is_of_proxy = answer.getheader("Content-Type") != PROBLEM_MEDIA_TYPE
    return 0.0 if answer.status >= 500 and is_of_proxy else None


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
    raise error_from_problem(problem, where)
