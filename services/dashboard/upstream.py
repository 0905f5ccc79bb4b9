"""HTTP client of another service, whose failures become UnavailableError."""

from collections.abc import Mapping
from typing import Any

import httpx
from pydantic import SecretStr, ValidationError

from dextouch.errors import UnavailableError
from dextouch.schemas import Problem, error_from_problem


class Upstream:
    """Client of another service's HTTP API."""

    def __init__(self, name: str, client: httpx.AsyncClient) -> None:
        self.name = name
        self._client = client

    @staticmethod
    def connect(name: str, url: str, *, key: SecretStr | None, timeout_s: float) -> "Upstream":
        """Create a client with a bounded connection pool, without sending a request."""
        headers = {"authorization": f"Bearer {key.get_secret_value()}"} if key else {}
        limits = httpx.Limits(max_connections=8, max_keepalive_connections=4)
        client = httpx.AsyncClient(
            base_url=url, headers=headers, timeout=timeout_s, limits=limits, trust_env=False
        )
        return Upstream(name, client)

    async def json(self, method: str, path: str, *, body: Mapping[str, Any] | None = None) -> Any:  # noqa: ANN401 - another service's JSON; views.py checks it
        """Send a request and return the JSON response.

        Raises:
            UnavailableError: no response, or not JSON.
            DexTouchError: a refusal of the service, as its own class.
        """
        response = await self._send(method, path, body)
        try:
            return response.json()
        except ValueError as error:
            raise UnavailableError(
                f"{self.name}: {method} {path} did not answer with JSON", service=self.name
            ) from error

    async def content(self, path: str) -> tuple[bytes, Mapping[str, str]]:
        """Body and headers of a GET request."""
        response = await self._send("GET", path, None)
        return response.content, response.headers

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

    async def _send(self, method: str, path: str, body: Mapping[str, Any] | None) -> httpx.Response:
        try:
            response = await self._client.request(method, path, json=body)
        except httpx.HTTPError as error:
            raise UnavailableError(
                f"{self.name}: no answer to {method} {path} ({type(error).__name__}); "
                "is the service running?",
                service=self.name,
            ) from error
        if response.is_success:
            return response
        try:
            problem = Problem.model_validate_json(response.content)
        except ValidationError as error:
            raise UnavailableError(
                f"{self.name}: {method} {path} answered {response.status_code} without a reason",
                service=self.name,
            ) from error
        raise error_from_problem(problem)
