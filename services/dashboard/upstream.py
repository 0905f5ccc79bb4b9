"""HTTP client of another service, whose failures become UnavailableError."""

import ssl
import time
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any, Final, TypeVar
from urllib.parse import quote

import httpx
from prometheus_client import Histogram
from pydantic import SecretStr, TypeAdapter, ValidationError

from dextouch.clients import service_address
from dextouch.errors import InvalidInputError, NotFoundError, UnavailableError
from dextouch.schemas import Problem, error_from_problem, first_problems
from dextouch.tracing import trace_headers

Form = TypeVar("Form")
# Scopes of operators, and of administrators, who have theirs beside it.
SCOPE: Final = "operate"
ENROL: Final = "enrol"
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
        """Create a client with a bounded connection pool, without sending a request.

        Raises:
            InvalidInputError: a URL that is none.
        """
        service_address(url, what=name)
        headers = {"authorization": f"Bearer {key.get_secret_value().strip()}"} if key else {}
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
        body: Mapping[str, Any] | bytes | None = None,
        *,
        headers: Mapping[str, str] | None = None,
        timeout_s: float | None = None,
        stream: bool = False,
    ) -> httpx.Response:
        """Response to a request, also "304 Not Modified"; bytes are sent as they are.

        `timeout_s` replaces that of the client. With `stream` the content is not read yet, and the
        caller closes it.

        Raises:
            InvalidInputError: a body that is no JSON, or a header or query that cannot be sent.
            UnavailableError: no response, or a refusal without a reason.
            DexTouchError: a refusal of the service, as its own class.
        """
        given = {"content": body or None} if isinstance(body, bytes) else {"json": body}
        try:
            request = self._client.build_request(
                method,
                path,
                headers={**(headers or {}), **trace_headers()},
                **given,
                timeout=httpx.USE_CLIENT_DEFAULT if timeout_s is None else timeout_s,
            )
        except (ValueError, httpx.InvalidURL) as error:
            where = f"{self.name}: {method} {path.partition('?')[0]}"
            raise InvalidInputError(f"{where}: cannot be sent ({error})") from error
        path = request.url.path
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
        raise error_from_problem(problem, self.name)

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


def path_part(name: str) -> str:
    """A name from outside as one part of a path; raises NotFoundError if it leads to another."""
    if name in {".", ".."}:
        raise NotFoundError(f"got {name!r} in a path, expected the name of an item")
    return quote(name, safe="")


@dataclass(frozen=True)
class Forwarded:
    """A route of a service, `path` below its /v1, offered as /v1/SERVICE/PATH.

    One that changes something has an `action`, by which the audit log calls it, and a body of at
    most `max_kib`. The key that signed in needs `scope`. A `streamed` response is passed on as it
    comes.
    """

    service: str
    path: str
    action: str = ""
    max_kib: int = 64
    scope: str = SCOPE
    streamed: bool = False

    @property
    def method(self) -> str:
        """Of the request."""
        return "POST" if self.action else "GET"


# Paths below a service and the beginning that they share.
_READ: Final[Mapping[tuple[str, str], tuple[str, ...]]] = {
    ("acquisition", ""): ("/health", "/health/events", "/health/history", "/uploads"),
    ("alignment", ""): ("/alignments", "/alignments/{alignment_id}"),
    ("alignment", "/calibration"): ("", "/run", "/run/image"),
    ("episode_store", ""): ("/episodes", "/recordings", "/trash", "/uploads", "/enrolments"),
    ("episode_store", "/catalog"): ("/items", "/groups", "/values", "/hours", "/hours/{field}"),
    ("episode_store", "/catalog/clicks"): ("", "/file"),
    ("episode_store", "/catalog/lineage"): ("/{kind}/{item_id}",),
    ("episode_store", "/episodes/{item_id}"): ("", "/clicks", "/streams/{stream}"),
    ("episode_store", "/recordings/{item_id}"): ("/attributes", "/streams/{stream}"),
    ("episode_store", "/notes"): ("/{kind}/{item_id}",),
    ("episode_store", "/playback/{kind}/{item_id}"): ("", "/images/{camera}", "/signals"),
    ("episode_store", "/playback/episode/{item_id}"): ("/robot_hands",),
    ("studies", "/studies"): ("", "/{name}", "/{name}/rollouts", "/{name}/picture"),
}
_CALIBRATION: Final = {
    "runs": "start calibration",
    "run/answer": "answer calibration",
    "run/take": "keep calibration place",
    "run/drop": "drop calibration place",
    "run/finish": "finish calibration",
    "run/cancel": "cancel calibration",
    "practice/start": "start practice devices",
    "practice/stop": "stop practice devices",
}
FORWARDED: Final = (
    *(Forwarded(of[0], of[1] + path) for of, paths in _READ.items() for path in paths),
    Forwarded("acquisition", "/faults/{fault}", "simulate fault"),
    Forwarded("episode_store", "/catalog/reviews", "review", 256),
    Forwarded("episode_store", "/catalog/relabel", "relabel", 256),
    Forwarded("episode_store", "/episodes/{item_id}/clicks", "mark objects", 16),
    Forwarded("episode_store", "/episodes/{item_id}/trim", "trim", 16),
    Forwarded("episode_store", "/notes/{kind}/{item_id}", "add note", 16),
    Forwarded("episode_store", "/notes/{kind}/{item_id}/remove", "remove note", 16),
    Forwarded("episode_store", "/downloads", "download", 1024, streamed=True),
    Forwarded("episode_store", "/trash", "delete", 256),
    Forwarded("episode_store", "/trash/restore", "restore", 256),
    Forwarded("episode_store", "/enrolments", "enrol station", scope=ENROL),
    Forwarded("episode_store", "/enrolments/{station}/revoke", "revoke station", scope=ENROL),
    Forwarded("alignment", "/alignments", "align"),
    Forwarded("alignment", "/alignments/{alignment_id}/cancel", "cancel alignment"),
    *(Forwarded("alignment", f"/calibration/{path}", name) for path, name in _CALIBRATION.items()),
)
