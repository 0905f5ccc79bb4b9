"""Address that a service listens on, checked before anything is loaded or started."""

import errno
import socket

from dextouch.errors import ConflictError, InvalidInputError


def bound_socket(what: str, host: str, port: int, *, advice: str) -> socket.socket:
    """A socket that is bound to an address, which does not listen yet; port 0 selects a free one.

    Args:
        what: names the service in errors.
        host: name or address of this machine.
        port: to bind.
        advice: how another port is chosen.

    Raises:
        ConflictError: another program uses the port.
        InvalidInputError: the host is not of this machine, or the port needs rights.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # The protocol is explicit so that asyncio sets TCP_NODELAY; otherwise every response takes 40
    # ms.
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
