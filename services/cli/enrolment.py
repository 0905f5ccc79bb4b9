"""Commands that enrol stations at an episode store, list them, and revoke their keys."""

import json
import os
from collections.abc import Sequence
from contextlib import closing
from datetime import datetime
from pathlib import Path
from typing import Final, TypeVar
from urllib.parse import quote

from pydantic import BaseModel, SecretStr, ValidationError

from dextouch.command_line import CommandParser, add_json, write_result
from dextouch.data_folder import default_enrolment
from dextouch.errors import UnavailableError

FormT = TypeVar("FormT", bound=BaseModel)
KEY_VARIABLE: Final = "DEXTOUCH_KEY"
PATH: Final = "/v1/enrolments"


def station_enrol_main(argv: Sequence[str]) -> int:
    """Exchange a token for the station's key, and write it to a file."""
    parser = CommandParser(
        prog="dextouch station enrol",
        description="Exchange a one-time token for this station's key of the episode store, and "
        "write it to a file that only its owner can read. dextouch station serve uploads with it "
        "from its next start. Tokens come from the page System of the dashboard, or from "
        "dextouch store enrol.",
        epilog="example:\n  dextouch station enrol http://store.lab:8081 TOKEN",
    )
    parser.add_argument("url", metavar="URL", help="address of the episode store")
    parser.add_argument("token", metavar="TOKEN", help="one-time token, valid for 15 minutes")
    parser.add_argument(
        "--output",
        type=Path,
        metavar="PATH",
        help="file of the key (default: enrolment.json in the data folder)",
    )
    add_json(parser)
    options = parser.parse_args(list(argv))
    from dextouch.schemas import StationKey
    from services.acquisition.settings import Enrolment, check_writable, write_enrolment

    path, url = options.output or default_enrolment(), options.url.rstrip("/")
    check_writable(path)
    got = _ask(StationKey, "POST", f"{PATH}/exchange", url=url, body={"token": options.token})
    write_enrolment(
        path,
        Enrolment(station=got.station, episode_store_url=url, episode_store_key=SecretStr(got.key)),
    )
    print(f"enrolled as {got.station}; the key is in {path}")
    used = "" if options.output is None else f" with --enrolment {path}"
    print(f"(re)start the station to upload with it: dextouch station serve{used}")
    write_result(
        options.json, {"station": got.station, "episode_store_url": url, "path": str(path)}
    )
    return 0


def store_enrol_main(argv: Sequence[str]) -> int:
    """Get a one-time token for a station."""
    parser = _administration(
        "enrol", "Get a one-time token with which a station gets a key of its own.", "desk_3"
    )
    parser.add_argument(
        "--renew",
        action="store_true",
        help="a new key beside the present one, until revoke --former",
    )
    options = parser.parse_args(list(argv))
    from dextouch.schemas import EnrolmentToken

    body = {"station": options.station, "renew": options.renew}
    got = _ask(EnrolmentToken, "POST", PATH, url=options.url, key=options.key, body=body)
    command = f"dextouch station enrol {options.url} {got.token}"
    print(f"run this on {got.station}, once, before {_shown(got.expires_at)}:\n\n  {command}\n")
    write_result(options.json, got.model_dump(mode="json") | {"command": command})
    return 0


def store_stations_main(argv: Sequence[str]) -> int:
    """List the enrolments of a store."""
    parser = _administration("stations", "List enrolled, waiting and revoked stations.")
    options = parser.parse_args(list(argv))
    from dextouch.schemas import StationEnrolments

    listed = _ask(StationEnrolments, "GET", PATH, url=options.url, key=options.key)
    for one in listed.enrolments:
        ended = one.revoked_at or one.enrolled_at or one.requested_at
        print(f"{one.station:<32}  {one.state:<8}  since {_shown(ended)}  {one.enrolled_from}")
    if not listed.needs_key:
        print("the store has no api_keys: stations upload without a key")
    write_result(options.json, listed.model_dump(mode="json"))
    return 0


def store_revoke_main(argv: Sequence[str]) -> int:
    """Revoke the key of a station."""
    parser = _administration(
        "revoke", "Refuse the keys of an enrolled station, or its unused token, at once.", "desk_3"
    )
    parser.add_argument("--former", action="store_true", help="all but the newest key")
    options = parser.parse_args(list(argv))
    from dextouch.schemas import StationEnrolments

    query = "?former=true" if options.former else ""
    path = f"{PATH}/{quote(options.station, safe='')}/revoke{query}"
    listed = _ask(StationEnrolments, "POST", path, url=options.url, key=options.key)
    print(f"revoked: {options.station}{' (former keys)' * options.former}")
    write_result(options.json, listed.model_dump(mode="json"))
    return 0


def _administration(name: str, does: str, usual: str = "") -> CommandParser:
    """Parser of a command for administrators; `usual` is the station of its example."""
    parser = CommandParser(
        prog=f"dextouch store {name}",
        description=does,
        epilog=f"example:\n  dextouch store {name} {usual}".rstrip()
        + " --url http://store.lab:8081",
    )
    if usual:
        parser.add_argument("station", metavar="STATION", help="name of the station")
    parser.add_argument("--url", required=True, metavar="URL", help="address of the store")
    parser.add_argument(
        "--key",
        metavar="KEY",
        default=os.environ.get(KEY_VARIABLE),
        help=f"API key with the scope enrol (default: the variable {KEY_VARIABLE})",
    )
    add_json(parser)
    return parser


def _ask(
    form: type[FormT],
    method: str,
    path: str,
    *,
    url: str,
    key: str | None = None,
    body: dict[str, str | bool] | None = None,
) -> FormT:
    from dextouch.clients import HttpLink

    content = None if body is None else json.dumps(body).encode()
    with closing(HttpLink(url, api_key=key)) as link:
        reply = link.request(method, path, body=content)
    try:
        return form.model_validate_json(reply.body)
    except ValidationError as error:
        from dextouch.schemas import first_problems

        raise UnavailableError(
            f"unexpected response to {method} {path} ({first_problems(error)}); is this the "
            "address of an episode store?"
        ) from error


def _shown(at: datetime) -> str:
    return f"{at.astimezone():%Y-%m-%d %H:%M}"
