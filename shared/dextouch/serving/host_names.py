"""Host names and origins in the form in which browsers send them."""

import ipaddress
import re
from contextlib import suppress

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
