"""Requests to another service in, its JSON or bytes out; what goes wrong is an UnavailableError."""

from collections.abc import Mapping
from typing import Any

import httpx
from pydantic import SecretStr, ValidationError

from dextouch.errors import UnavailableError
from dextouch.schemas.problems import Problem, error_from_problem


class Upstream:
    """One other service, asked through its HTTP API only."""

    def __init__(self, name: str, client: httpx.AsyncClient) -> None:
        self.name = name
        self._client = client

    @staticmethod
    def connect(name: str, url: str, *, key: SecretStr | None, timeout_s: float) -> "Upstream":
        """A client with a bounded pool; nothing is sent yet."""
        headers = {"authorization": f"Bearer {key.get_secret_value()}"} if key else {}
        limits = httpx.Limits(max_connections=8, max_keepalive_connections=4)
        client = httpx.AsyncClient(
            base_url=url, headers=headers, timeout=timeout_s, limits=limits, trust_env=False
        )
        return Upstream(name, client)

    async def json(self, method: str, path: str, *, body: Mapping[str, Any] | None = None) -> Any:  # noqa: ANN401 - another service's JSON; views.py checks it
        """The JSON answer.

        Raises:
            UnavailableError: no answer, or one that is no JSON.
            DexTouchError: what the service refused, as its own class.
        """
        response = await self._send(method, path, body)
        try:
            return response.json()
        except ValueError as error:
            raise UnavailableError(
                f"{self.name}: {method} {path} did not answer with JSON", service=self.name
            ) from error

    async def content(self, path: str) -> tuple[bytes, Mapping[str, str]]:
        """The body and headers of a GET."""
        response = await self._send("GET", path, None)
        return response.content, response.headers

    async def ready(self) -> tuple[bool, str]:
        """Whether work may be sent, and what is missing otherwise."""
        try:
            response = await self._client.get("/readyz")
            waiting = response.json().get("waiting_for", [])
        except (httpx.HTTPError, ValueError, AttributeError) as error:
            return False, f"no answer ({type(error).__name__})"
        if response.is_success:
            return True, ""
        return False, "waiting for " + ", ".join(str(item) for item in waiting)

    async def close(self) -> None:
        """Give the connections back."""
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
