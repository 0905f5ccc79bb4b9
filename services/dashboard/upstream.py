"""HTTP client of another service, whose failures become UnavailableError."""

import ssl
import time
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any, TypeVar

import httpx
from prometheus_client import Histogram
from pydantic import SecretStr, TypeAdapter, ValidationError

from dextouch.errors import UnavailableError
from dextouch.schemas import Problem, error_from_problem, first_problems
from dextouch.tracing import trace_headers

Form = TypeVar("Form")
SECONDS = (0.005, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


def upstream_histogram() -> Histogram:
    """A metric of requests to other services, in no registry yet."""
    return Histogram(
        "dextouch_upstream_request_seconds",
        "Time of a request to another service: answered, refused or failed.",
        ("upstream", "outcome"),
        buckets=SECONDS,
        registry=None,
    )


class Upstream:
    """Client of another service's HTTP API."""

    def __init__(self, name: str, client: httpx.AsyncClient) -> None:
        self.name = name
        self.seconds = upstream_histogram()
        self._client = client

    @property
    def address(self) -> str:
        """URL of the service, without credentials."""
        return str(self._client.base_url.copy_with(username=None, password=None)).rstrip("/")

    @staticmethod
    def connect(name: str, url: str, *, key: SecretStr | None, timeout_s: float) -> "Upstream":
        """Create a client with a bounded connection pool, without sending a request."""
        headers = {"authorization": f"Bearer {key.get_secret_value()}"} if key else {}
        limits = httpx.Limits(max_connections=8, max_keepalive_connections=4)
        client = httpx.AsyncClient(
            base_url=url,
            headers=headers,
            timeout=timeout_s,
            limits=limits,
            # Authorities of the system, or of SSL_CERT_FILE; no proxy settings.
            verify=ssl.create_default_context(),
            trust_env=False,
        )
        return Upstream(name, client)

    async def read(
        self,
        form: type[Form],
        path: str,
        *,
        method: str = "GET",
        body: Mapping[str, Any] | None = None,
        timeout_s: float | None = None,
    ) -> Form:
        """Response to a request as this model, or tuple of models; otherwise as `send`.

        Raises:
            UnavailableError: no response, or one of another form.
            DexTouchError: a refusal of the service, as its own class.
        """
        response = await self.send(method, path, body, timeout_s=timeout_s)
        try:
            # A service of a later release may say more.
            return TypeAdapter(form).validate_json(response.content, extra="ignore")
        except ValidationError as error:
            raise UnavailableError(
                f"{self.name}: unexpected response to {method} {path} ({first_problems(error)})",
                service=self.name,
            ) from error

    async def send(
        self,
        method: str,
        path: str,
        body: Mapping[str, Any] | None = None,
        *,
        timeout_s: float | None = None,
    ) -> httpx.Response:
        """Response to a request, with `body` as JSON; `timeout_s` replaces that of the client.

        Raises:
            UnavailableError: no response, or a refusal without a reason.
            DexTouchError: a refusal of the service, as its own class.
        """
        limit = httpx.USE_CLIENT_DEFAULT if timeout_s is None else timeout_s
        return await self._sent(self._client.build_request(method, path, json=body, timeout=limit))

    async def forward(
        self,
        method: str,
        path: str,
        headers: Mapping[str, str],
        content: bytes,
        *,
        timeout_s: float | None = None,
        stream: bool = False,
    ) -> httpx.Response:
        """Response to a request of a browser, also "304 Not Modified"; otherwise as `send`.

        With `stream` its content is not read yet, and the caller closes it.
        """
        request = self._client.build_request(
            method,
            path,
            headers=dict(headers),
            content=content or None,
            timeout=httpx.USE_CLIENT_DEFAULT if timeout_s is None else timeout_s,
        )
        return await self._sent(request, stream=stream)

    async def _sent(self, request: httpx.Request, *, stream: bool = False) -> httpx.Response:
        method, path = request.method, request.url.path
        request.headers.update(trace_headers())
        began_s = time.perf_counter()
        outcome = "failed"
        try:
            response = await self._client.send(request, stream=stream)
            if stream and response.is_error:
                await response.aread()
            outcome = "refused" if response.is_error else "answered"
        except httpx.HTTPError as error:
            raise self._no_answer(method, path, error) from error
        finally:
            self.seconds.labels(self.name, outcome).observe(time.perf_counter() - began_s)
        if response.is_success or response.status_code == HTTPStatus.NOT_MODIFIED:
            return response
        try:
            problem = Problem.model_validate_json(response.content)
        except ValidationError as error:
            raise UnavailableError(
                f"{self.name}: {method} {path} answered {response.status_code} without a reason",
                service=self.name,
            ) from error
        raise error_from_problem(problem)

    async def answer(self, path: str) -> httpx.Response:
        """Any response to a GET request, also a refusal.

        Raises:
            UnavailableError: no response.
        """
        try:
            return await self._client.get(path)
        except httpx.HTTPError as error:
            raise self._no_answer("GET", path, error) from error

    def _no_answer(self, method: str, path: str, error: httpx.HTTPError) -> UnavailableError:
        return UnavailableError(
            f"{self.name}: no answer to {method} {path} ({type(error).__name__}); "
            "is the service running?",
            service=self.name,
            no_answer=True,
        )

    async def ready(self) -> tuple[bool, str]:
        """Readiness of the service, and what is missing otherwise."""
        try:
            response = await self._client.get("/readyz")
            waiting = response.json().get("waiting_for", [])
        except (httpx.HTTPError, ValueError, AttributeError) as error:
            return False, f"no answer ({type(error).__name__})"
        if response.is_success:
            return True, ""
        return False, "waiting for " + ", ".join(str(item) for item in waiting)

    async def close(self) -> None:
        """Close the connections."""
        await self._client.aclose()
