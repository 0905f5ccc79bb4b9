"""Service settings from flags, environment and file, and running a service from them."""

import argparse
import gc
import inspect
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Annotated, Any, Literal, TypeVar

from fastapi import FastAPI
from pydantic import AfterValidator, Field, ValidationError, model_validator
from pydantic_settings import (
    BaseSettings,
    CliApp,
    CliSettingsSource,
    SettingsConfigDict,
    SettingsError,
)

from dextouch.command_line import CommandParser
from dextouch.errors import InvalidInputError
from dextouch.serving.configuration_file import CommandSettings, explained, section_of
from dextouch.serving.host_names import (
    canonical_host,
    canonical_network,
    canonical_origin,
    is_loopback,
)
from dextouch.serving.keys import ApiKey
from dextouch.serving.listening import bound_socket
from dextouch.serving.logs import configure_logging
from dextouch.serving.spans import configure_spans

# Keep-alive, so that a policy may take this long between two chunks.
KEEP_ALIVE_S = 75
# Maximum size of a WebSocket message; the server closes the connection on larger ones.
MAX_WEBSOCKET_BYTES = 2**16
# Defaults that say nothing to a user of the command line.
_NO_DEFAULT = re.compile(r"\s*\((default: (null|\(\)|\{\})|default factory: [^)]*)\)$")
_NO_GROUP_DEFAULT = "default: null (undefined)"
_PLACEHOLDERS = {"int": "N", "float": "X", "Path": "PATH"}
_LIST = re.compile(r"tuple\[(.+),\.\.\.\]")

HostName = Annotated[str, AfterValidator(canonical_host)]
Origin = Annotated[str, AfterValidator(canonical_origin)]
Network = Annotated[str, AfterValidator(canonical_network)]
SettingsT = TypeVar("SettingsT", bound=BaseSettings)


class ServiceSettings(CommandSettings):
    """Settings common to all services; each service subclasses it.

    `host` other than loopback needs `api_keys`. Port 0 selects a free port. Routes have their own
    body limits, capped by `max_body_bytes`. Requests without a key must address the service by a
    loopback name or one of `allowed_hosts` (without port), and those that change state must not
    come from a web page, except of the service itself or of `allowed_origins`.
    """

    model_config = SettingsConfigDict(
        frozen=True, extra="forbid", env_nested_delimiter="__", env_prefix="DEXTOUCH_"
    )

    host: str = Field(
        default="127.0.0.1",
        description="address to listen on; addresses other than loopback need --api-keys",
    )
    port: int = Field(
        default=0, ge=0, le=65535, description="port to listen on; 0 for any free one"
    )
    api_keys: tuple[ApiKey, ...] = Field(
        default=(), description="API keys with their scopes, see docs/access.md"
    )
    max_body_bytes: int = Field(
        default=16 * 2**20, ge=1024, description="largest body of a request"
    )
    allowed_hosts: tuple[HostName, ...] = Field(
        default=(),
        description="host names other than loopback that are accepted without a key",
    )
    allowed_origins: tuple[Origin, ...] = Field(
        default=(),
        description="origins of the service behind a TLS proxy, such as https://lab.example",
    )
    trusted_proxies: tuple[Network, ...] = Field(
        default=(),
        description="addresses or networks of proxies, such as 10.0.0.7 or 10.0.0.0/24, whose "
        "X-Forwarded-For and X-Forwarded-Proto say who the client is and whether it uses TLS",
    )
    log_format: Literal["auto", "json", "console"] = Field(
        default="auto", description="auto: console at a terminal, JSON otherwise"
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="minimum level of log events"
    )
    max_connections: int = Field(
        default=512, ge=1, description="open connections; further clients get status 503"
    )
    client_timeout_s: float = Field(
        default=20.0,
        gt=0,
        description="seconds that a client below 16 KiB/s may take to send a request or read a "
        "response",
    )
    shutdown_grace_s: int = Field(
        default=10, ge=0, le=600, description="seconds for requests in flight to finish"
    )

    @model_validator(mode="after")
    def _needs_keys_off_loopback(self) -> "ServiceSettings":
        if not self.api_keys and not is_loopback(self.host):
            raise ValueError(
                f"host {self.host} is not loopback and no api_keys are set; "
                "set at least one key with its scopes, or listen on 127.0.0.1"
            )
        names = [key.name for key in self.api_keys]
        if len(set(names)) != len(names):
            raise ValueError(f"api_keys: names must differ, got {names}")
        return self


ServiceT = TypeVar("ServiceT", bound=ServiceSettings)


def service_config(service: str, command: str | None = None) -> SettingsConfigDict:
    """The `model_config` of a service's settings class: variables DEXTOUCH_<SERVICE>_<FIELD>.

    Args:
        service: prefix of the variables.
        command: as users type it, such as `dextouch station`; names the program in its help.
    """
    return SettingsConfigDict(
        frozen=True,
        extra="forbid",
        env_prefix=f"DEXTOUCH_{service.upper()}_",
        env_nested_delimiter="__",
        cli_prog_name=command or service,
    )


def load_settings(cls: type[SettingsT], arguments: list[str]) -> SettingsT:
    """Load settings from flags, the environment, `dextouch.toml` and defaults, in this order.

    The help describes the command with the docstring of the class, which holds an example. Flags
    have dashes (`--num-steps`, `--limits.max-chunks`), booleans are switches (`--mock`,
    `--no-mock`), and lists are repeated or separated by commas.

    Raises:
        InvalidInputError: invalid values; all of them are listed.
        SystemExit: an unknown flag, or --help (after printing the usage).
    """
    source = CliSettingsSource[SettingsT](
        cls,
        root_parser=CommandParser(
            prog=cls.model_config.get("cli_prog_name"), description=inspect.getdoc(cls)
        ),
        add_argument_method=_add_argument,
        add_argument_group_method=_add_argument_group,
        cli_kebab_case="no_enums",
        cli_implicit_flags=True,
        cli_avoid_json=True,
        cli_hide_none_type=True,
        cli_parse_none_str="null",
    )
    try:
        return CliApp.run(cls, cli_args=arguments, cli_settings_source=source)
    except ValidationError as error:
        problems = explained(error, section_of(cls))
        raise InvalidInputError(f"settings of {cls.__name__}: {problems}") from error
    except SettingsError as error:
        raise InvalidInputError(
            f"settings of {cls.__name__}: {_malformed(cls, error)}; expected JSON, such as "
            '["A", "B"] for a list'
        ) from error


def _malformed(cls: type[BaseSettings], error: SettingsError) -> str:
    """What is no JSON: the environment variable of the field that an error names."""
    found = re.search(r'field "([^"]+)" from source "EnvSettingsSource"', str(error))
    if found is None:
        return str(error)
    variable = cls.model_config.get("env_prefix", "") + found[1].upper()
    return f"{found[1]}: variable {variable} is no JSON"


def _add_argument(
    context: argparse._ActionsContainer,
    *flags: str,
    **options: Any,  # noqa: ANN401 - argparse's own
) -> None:
    """Add one setting to a parser, with a readable placeholder and without empty defaults."""
    if "metavar" in options:
        options["metavar"] = _placeholder(options["metavar"], flags[0])
    if options.get("help") not in (None, argparse.SUPPRESS):
        options["help"] = _NO_DEFAULT.sub("", options["help"])
    context.add_argument(*flags, **options)


def _add_argument_group(
    parser: argparse.ArgumentParser, *, title: str, description: str | None
) -> argparse._ArgumentGroup:
    """Add a group of settings to a parser, without the default of groups that may be absent."""
    described = (description or "").removeprefix(_NO_GROUP_DEFAULT).strip()
    return parser.add_argument_group(title, described or None)


def _placeholder(kind: str, flag: str) -> str:
    """What a value looks like in help: N, PATH, or the name of its flag; `NAME,…` for a list."""
    if items := _LIST.fullmatch(kind):
        return f"{_placeholder(items[1], flag.removesuffix('s'))},…"
    if kind.startswith("dict[str,"):
        return "JSON"
    word = re.split(r"[-.]", flag)[-1].upper()
    return word if kind in {"str", "SecretStr"} else _PLACEHOLDERS.get(kind, kind)


def check_address(service: str, settings: ServiceSettings) -> None:
    """Check that a service can listen, before it opens anything.

    Raises:
        ConflictError: another program uses the port.
        InvalidInputError: the host is not of this machine, or the port needs rights.
    """
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

    Args:
        app: the application.
        settings: its host, port and grace.
        drain: called at SIGTERM, so that the application refuses new work.
        drain_s: time from then until its port is closed; at once without `drain`.

    Raises:
        DexTouchError: the application could not start.
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
        told = getattr(app.state, "start_error", None)
        if told is not None:
            raise told
        sys.exit(STARTUP_FAILURE)


def server_options(settings: ServiceSettings, *, grace_s: int) -> dict[str, Any]:
    """Options of uvicorn for every service, alone or beside others.

    Args:
        settings: of the service; they limit its connections.
        grace_s: time that requests in flight get to end.
    """
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
        "timeout_graceful_shutdown": grace_s,
    }


def serve(
    service: str,
    kind: type[ServiceT],
    create_app: Callable[[ServiceT], FastAPI],
    arguments: Sequence[str],
) -> int:
    """Run a service until SIGINT or SIGTERM, with settings from flags and environment.

    Args:
        service: name in log events.
        kind: class of its settings.
        create_app: creates the application from them.
        arguments: flags of the command line.

    Returns:
        0, the exit status.

    Raises:
        InvalidInputError: invalid settings.
        ConflictError: another program uses the port.
    """
    settings = load_settings(kind, list(arguments))
    check_address(service, settings)
    configure_logging(service=service, log_format=settings.log_format, level=settings.log_level)
    configure_spans(service)
    run(create_app(settings), settings)
    return 0
