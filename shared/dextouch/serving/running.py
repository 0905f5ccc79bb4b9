"""Running a service from its settings until a signal ends it."""

import errno
import gc
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

import structlog
from fastapi import FastAPI

from dextouch.errors import ConflictError, InvalidInputError
from dextouch.serving.logs import configure_logging, hide_secrets
from dextouch.serving.settings import ServiceSettings, load_settings
from dextouch.serving.spans import SPANS

logger = structlog.get_logger(__name__)


def bound_socket(what: str, host: str, port: int, *, advice: str) -> socket.socket:
    """A socket that is bound to an address, which does not listen yet; port 0 selects a free one.

    `what` names the service in errors, `advice` says how another port is chosen.

    Raises:
        ConflictError: another program uses the port.
        InvalidInputError: the host is not of this machine, or the port needs rights.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With the protocol asyncio sets TCP_NODELAY; otherwise every response takes 40 ms.
    bound = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((host, port))
    except (OSError, UnicodeError) as error:
        bound.close()
        raise _refusal(f"{what}: cannot listen on {host}:{port}", host, error, advice) from error
    return bound


def _refusal(
    where: str, host: str, error: OSError | UnicodeError, advice: str
) -> ConflictError | InvalidInputError:
    code = None if isinstance(error, UnicodeError) else error.errno
    if code == errno.EADDRINUSE:
        return ConflictError(f"{where}: another program uses this port; stop it, or {advice}")
    if code in {errno.EACCES, errno.EPERM}:
        return InvalidInputError(
            f"{where}: this user may not use this port; take one of 1024 or above: {advice}"
        )
    return InvalidInputError(
        f"{where}: {host!r} is not an address of this machine ({error}); take 127.0.0.1 for "
        "this machine only, or 0.0.0.0 for all its addresses"
    )


# Keep-alive, so that a policy may take this long between two chunks.
KEEP_ALIVE_S = 75
# Maximum size of a WebSocket message; the server closes the connection on larger ones.
MAX_WEBSOCKET_BYTES = 2**16

ServiceT = TypeVar("ServiceT", bound=ServiceSettings)


def check_address(service: str, settings: ServiceSettings) -> None:
    """Check that a service can listen, before it opens anything; raises as `bound_socket`."""
    variable = f"{settings.model_config.get('env_prefix', '')}PORT"
    advice = f"choose another with --port (or {variable}), 0 for any free one"
    # uvicorn makes its own sockets, of every address of the host's name.
    bound_socket(service, settings.host, settings.port, advice=advice).close()


def run(
    app: FastAPI,
    settings: ServiceSettings,
    *,
    drain: Callable[[], object] | None = None,
    drain_s: float = 0.0,
) -> None:
    """Serve until SIGINT or SIGTERM; requests in flight get `shutdown_grace_s` to end.

    `drain` is called at SIGTERM, so that the application refuses new work; its port is closed
    `drain_s` later, at once without `drain`. Raises a DexTouchError if the application could not
    start.
    """
    import uvicorn
    from uvicorn.config import STARTUP_FAILURE

    from dextouch.serving.workers import DrainingServer

    # Without it each full garbage collection visits all modules: a body of 1 MiB with 300,000 lists
    # causes so many that decoding takes 0.36 instead of 0.05 s.
    gc.collect()
    gc.freeze()
    options = server_options(settings, grace_s=settings.shutdown_grace_s)
    config = uvicorn.Config(app, host=settings.host, port=settings.port, **options)
    is_working = getattr(app.state, "is_working", None)
    server = DrainingServer(config, drain=drain, drain_s=drain_s, is_working=is_working)
    # After a graceful end uvicorn repeats the signal that ended it.
    with suppress(KeyboardInterrupt):
        server.run()
    if not server.started:
        start_error = getattr(app.state, "start_error", None)
        if start_error is not None:
            raise start_error
        sys.exit(STARTUP_FAILURE)


def server_options(settings: ServiceSettings, *, grace_s: int) -> dict[str, Any]:
    """Options of uvicorn for every service, whose requests in flight get `grace_s` to end."""
    from dextouch.serving.connections import limited_protocols

    return limited_protocols(
        max_connections=settings.max_connections, client_timeout_s=settings.client_timeout_s
    ) | {
        "log_config": None,
        "access_log": False,
        "server_header": False,
        # The application reads them if it has trusted_proxies.
        "proxy_headers": False,
        "timeout_keep_alive": KEEP_ALIVE_S,
        "ws_max_size": MAX_WEBSOCKET_BYTES,
        # A small compressed message may be large in memory; images and touch hardly shrink.
        "ws_per_message_deflate": False,
        "timeout_graceful_shutdown": grace_s,
    }


def serve(
    service: str,
    kind: type[ServiceT],
    create_app: Callable[[ServiceT], FastAPI],
    arguments: Sequence[str],
) -> int:
    """Run a service until a signal ends it, with settings of a class from flags and environment.

    Raises:
        InvalidInputError: invalid settings.
        ConflictError: another program uses the port.
    """
    settings = load_settings(kind, list(arguments))
    check_address(service, settings)
    configure_logging(service=service, log_format=settings.log_format, level=settings.log_level)
    SPANS.configure(service)
    app = create_app(settings)
    reload_keys_at_hangup(app, lambda: load_settings(kind, list(arguments)))
    run(SPANS.close_with(app), settings)
    return 0


def reload_keys_at_hangup(app: FastAPI, load: Callable[[], ServiceSettings]) -> None:
    """At SIGHUP accept the `api_keys` that the settings have then, without a restart.

    A mistake in them is logged, and changes nothing. A service at a terminal ends with it.
    """

    def reload(*_: object) -> None:
        access = app.state.access
        settings = settings_with_keys(load, has_keys=access.has_keys)
        if settings is None:
            return
        others = access.names - access.key_names
        access.set_keys(settings.api_keys)
        logger.warning("keys_reloaded", names=sorted(access.key_names))
        if doubled := sorted(others & access.key_names):
            # Such as two people who would be one rater.
            reason = "a link or an enrolled key has this name, too; choose another, or revoke it"
            logger.error("key_names_doubled", names=doubled, reason=reason)

    if sys.stdin is None or not sys.stdin.isatty():
        signal.signal(signal.SIGHUP, reload)


def settings_with_keys(
    load: Callable[[], ServiceSettings], *, has_keys: bool
) -> ServiceSettings | None:
    """The settings as they are now; a running service that `has_keys` may take their `api_keys`.

    None, with the reason in the log, if they have a mistake, or would open or close the service.
    """
    try:
        settings = load()
    except InvalidInputError as error:
        logger.error("keys_not_reloaded", reason=error.message)  # noqa: TRY400
        return None
    if not (settings.api_keys and has_keys):
        reason = "a service gets its first key, and loses its last one, when it starts"
        logger.error("keys_not_reloaded", reason=reason)
        return None
    hide_secrets(settings)
    return settings
