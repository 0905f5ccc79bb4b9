"""Parsing and validation of object storage URLs, `s3://bucket/prefix?option=value`."""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import parse_qsl, unquote, urlsplit

from pydantic import Field, ValidationError

from dextouch.data_folder import data_folder
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.frozen_model import FrozenModel

MIB = 1 << 20
_SECRETS = frozenset({"access_key_id", "secret_access_key", "session_token"})


class ObjectOptions(FrozenModel):
    """Connection options of a bucket; None leaves an option to obstore's AWS_* environment.

    Attributes:
        endpoint: URL of a service other than Amazon S3, `https://…`.
        region: of the bucket.
        allow_http: whether an unencrypted endpoint `http://…` may be used.
        skip_signature: read a public bucket without credentials.
        virtual_hosted_style_request: whether the bucket is part of the host's name.
        access_key_id, secret_access_key, session_token: credentials; refused in a URL.
        max_retries: of one request after transient errors.
        retry_timeout_s: time after which no retry starts.
        cache_bytes: size of the in-memory block cache; 0 disables it.
        work_folder: where groups are written before they are uploaded.
    """

    endpoint: str | None = None
    region: str | None = None
    allow_http: bool | None = None
    skip_signature: bool | None = None
    virtual_hosted_style_request: bool | None = None
    access_key_id: str | None = Field(default=None, repr=False)
    secret_access_key: str | None = Field(default=None, repr=False)
    session_token: str | None = Field(default=None, repr=False)
    max_retries: int = Field(default=5, ge=0, le=100)
    retry_timeout_s: float = Field(default=30.0, gt=0, le=300)
    cache_bytes: int = Field(default=64 * MIB, ge=0)
    work_folder: Path | None = None


@dataclass(frozen=True)
class ObjectAddress:
    """A bucket, the common prefix of its keys (without outer slashes), and connection options."""

    bucket: str
    prefix: str
    options: ObjectOptions

    def __str__(self) -> str:
        return "/".join(part for part in (f"s3://{self.bucket}", self.prefix) if part)

    @property
    def work_folder(self) -> Path:
        """The given work folder, or one below the data folder that is unique to this address."""
        if self.options.work_folder is not None:
            return self.options.work_folder
        name = re.sub(r"[^a-z0-9]+", "-", str(self).removeprefix("s3://").lower()).strip("-")
        return data_folder() / "work" / f"{name[:80]}-{self.fingerprint[:8]}"

    @property
    def fingerprint(self) -> str:
        """Hexadecimal id, equal for addresses of the same location."""
        place = f"{self.options.endpoint or ''} {self}"
        return hashlib.sha256(place.encode()).hexdigest()


def parse_address(
    url: str, storage_options: Mapping[str, str], work_folder: str | Path | None
) -> ObjectAddress:
    """Parse a URL; explicit options take precedence over those in the URL.

    Raises:
        InvalidInputError: no bucket, secrets in the URL, or an invalid option value.
        UnknownNameError: an unknown option.
    """
    parts = urlsplit(url)
    where = f"{parts.scheme}://{parts.hostname or ''}{parts.path}"
    if not parts.hostname or parts.username or parts.port or parts.fragment:
        raise InvalidInputError(
            f"episode store: got {where!r}, expected s3://bucket/prefix?options"
        )
    query = dict(parse_qsl(parts.query, keep_blank_values=True))
    if secrets := sorted(_SECRETS & set(query)):
        raise InvalidInputError(
            f"{where}: got {secrets} in the address, which ends up in logs; give them as storage "
            "options or as AWS_* environment"
        )
    given: dict[str, object] = {**query, **storage_options}
    if work_folder is not None:
        given["work_folder"] = work_folder
    for name in given:
        if name not in ObjectOptions.model_fields:
            raise UnknownNameError(f"option of {where}", name, list(ObjectOptions.model_fields))
    prefix = unquote(parts.path).strip("/")
    if any(part in {"", ".", ".."} for part in prefix.split("/")) and prefix:
        raise InvalidInputError(f"{where}: got an empty or dotted part in the prefix {prefix!r}")
    try:
        options = ObjectOptions.model_validate(given)
    except ValidationError as error:
        # Option names only: the values may be secret.
        names = sorted({str(problem["loc"][0]) for problem in error.errors()})
        problem = error.errors(include_input=False)[0]["msg"]
        raise InvalidInputError(f"{where}: invalid options {names} ({problem})") from None
    return ObjectAddress(parts.hostname, prefix, options)
