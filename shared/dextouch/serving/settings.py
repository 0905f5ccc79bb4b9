"""Service settings from flags, environment and file, and host names as browsers send them.

Imported by every command, also to show its help, so that it imports no server.
"""

import argparse
import inspect
import ipaddress
import re
from contextlib import suppress
from typing import Annotated, Any, Literal, TypeVar

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
from dextouch.serving.keys import ApiKey

# Defaults that say nothing to a user of the command line.
_NO_DEFAULT = re.compile(r"\s*\((default: (null|\(\)|\{\})|default factory: [^)]*)\)$")
_NO_GROUP_DEFAULT = "default: null (undefined)"
_PLACEHOLDERS = {"int": "N", "float": "X", "Path": "PATH"}
_LIST = re.compile(r"tuple\[(.+),\.\.\.\]")

HOST_NAME = re.compile(r"[a-z0-9_.-]+")
ORIGIN = re.compile(r"(https?)://(?:([a-z0-9_.-]+)|\[([0-9a-f:.]+)\])(?::([0-9]{1,5}))?")


def canonical_host(text: str) -> str:
    """A host name as browsers write it: in lower case, IPv6 addresses short, without brackets."""
    name = text.lower()
    if HOST_NAME.fullmatch(name):
        return name
    try:
        return str(ipaddress.IPv6Address(name))
    except ValueError:
        raise ValueError(
            f"got {text!r}, expected a name or an address without its port (every port is "
            "answered), IPv6 without brackets"
        ) from None


def canonical_origin(text: str) -> str:
    """An origin as browsers write it: in lower case, without the default port of its scheme."""
    parts = ORIGIN.fullmatch(text.lower())
    if parts is None or int(parts[4] or 0) > 65535:
        raise ValueError(
            f"got {text!r}, expected http(s)://HOST or http(s)://HOST:PORT without a path"
        )
    scheme, name, address, port = parts.groups()
    host = f"[{canonical_host(address)}]" if address else name
    is_default = port is None or (scheme, int(port)) in {("http", 80), ("https", 443)}
    return f"{scheme}://{host}" if is_default else f"{scheme}://{host}:{int(port)}"


def canonical_network(text: str) -> str:
    """An address or a network in its short form; a network ends with the length of its prefix."""
    try:
        if "/" in text:
            return str(ipaddress.ip_network(text))
        return str(ipaddress.ip_address(text))
    except ValueError as error:
        raise ValueError(
            f"got {text!r} ({error}), expected an address such as 10.0.0.7, or a network such as "
            "10.0.0.0/24"
        ) from None


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a socket bound to `host`."""
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


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
        default=(), description="host names other than loopback that are accepted without a key"
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
        grants = {key.name: (set(key.scopes), key.station) for key in self.api_keys}
        for key in self.api_keys:
            if grants[key.name] != (set(key.scopes), key.station):
                raise ValueError(
                    f"api_keys: got the name {key.name!r} with different scopes or stations; keys "
                    "of one name, such as an old and a new one, allow the same"
                )
        return self


def service_config(service: str, command: str | None = None) -> SettingsConfigDict:
    """The `model_config` of a service's settings class: variables DEXTOUCH_<SERVICE>_<FIELD>.

    `command` is what users type, such as `dextouch station`; it names the program in its help.
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
    `--no-mock`), and lists are repeated or separated by commas. Raises InvalidInputError that lists
    all invalid values, SystemExit for an unknown flag, or --help (after printing the usage).
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
