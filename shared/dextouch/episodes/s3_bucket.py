"""S3 buckets: their URLs, `s3://bucket/prefix?option=value`, and requests to one bucket."""

import builtins
import hashlib
import os
import re
import threading
from collections import OrderedDict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, unquote, urlsplit

import obstore
from obstore.exceptions import (
    AlreadyExistsError,
    BaseError,
    PermissionDeniedError,
    PreconditionError,
    UnauthenticatedError,
)
from obstore.store import S3Store
from pydantic import Field, ValidationError

from dextouch.data_folder import data_folder
from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    StorageError,
    UnavailableError,
    UnknownNameError,
)
from dextouch.frozen_model import FrozenModel

_NOT_PASSED_ON = {"allow_http", "max_retries", "retry_timeout_s", "cache_bytes", "work_folder"}
# The library puts the status code in the message where it has no exception class for it.
_STATUS = re.compile(r"status code: (\d{3})")
# The latter of one of several objects, whose answer as a whole has the status 200.
_CODE = re.compile(r"(?:<Code>|\(code: )(\w+)")
_CREDENTIAL_HOST = "169.254.16"
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
    cache_bytes: int = Field(default=64 << 20, ge=0)
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


def parse_address(url: str, storage_options: Mapping[str, str]) -> ObjectAddress:
    """Parse a URL; explicit options take precedence over those in the URL.

    Raises InvalidInputError without a bucket, for secrets in the URL, or for an invalid value,
    UnknownNameError for an unknown option.
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
    given = {**query, **storage_options}
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


@dataclass(frozen=True)
class ObjectFacts:
    """Metadata of an object (HEAD)."""

    key: str
    size: int
    etag: str
    modified: datetime


class LruCache:
    """Thread-safe cache of bytes that evicts the least recently used ones beyond a total size."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._guard = threading.Lock()
        self._values: OrderedDict[Hashable, bytes] = OrderedDict()
        self._size = 0

    def get(self, key: Hashable) -> bytes | None:
        """The value of a key; None if it is not in the cache."""
        with self._guard:
            value = self._values.get(key)
            if value is not None:
                self._values.move_to_end(key)
        return value

    def put(self, key: Hashable, value: bytes) -> None:
        """Add or replace a value."""
        with self._guard:
            self._size += len(value) - len(self._values.pop(key, b""))
            self._values[key] = value
            while self._size > self.capacity:
                self._size -= len(self._values.popitem(last=False)[1])


# The first process to use object storage; the library's threads do not exist in its forks.
_OWNER: list[int] = []


class Bucket:
    """One bucket below one prefix, with a cache of object blocks for its readers.

    Thread-safe, and picklable for spawned processes, not for forked ones.
    """

    def __init__(self, address: ObjectAddress) -> None:
        self.address = address
        options = address.options
        # Blocks by key and version of their object, and number.
        self.cache = LruCache(options.cache_bytes)
        config: Any = options.model_dump(exclude=_NOT_PASSED_ON, exclude_none=True)
        client: Any = options.model_dump(include={"allow_http"}, exclude_none=True)
        try:
            self._store = S3Store(
                address.bucket,
                prefix=address.prefix or None,
                config=config,
                client_options=client or None,
                retry_config={
                    "max_retries": options.max_retries,
                    "retry_timeout": timedelta(seconds=options.retry_timeout_s),
                },
            )
        except (BaseError, ValueError) as error:
            raise InvalidInputError(f"{address}: invalid options ({_first_line(error)})") from error

    def __reduce__(self) -> tuple[type["Bucket"], tuple[ObjectAddress]]:
        return Bucket, (self.address,)

    def get(self, key: str) -> bytes | None:
        """Contents of an object; None if it does not exist."""
        with suppress(FileNotFoundError), self._errors("read", key):
            return bytes(obstore.get(self._store, key).bytes())
        return None

    def head(self, key: str) -> ObjectFacts | None:
        """Metadata of an object; None if it does not exist."""
        with suppress(FileNotFoundError), self._errors("look at", key):
            return _facts(obstore.head(self._store, key))
        # A HEAD response has no body that could tell a missing bucket from a missing key.
        return None if self.get(key) is None else self.head(key)

    def tail(self, key: str, length: int) -> tuple[ObjectFacts, bytes] | None:
        """The last bytes of an object, all if it is shorter; None if it does not exist."""
        with suppress(FileNotFoundError), self._errors("read", key):
            try:
                found = obstore.get(self._store, key, options={"range": {"suffix": length}})
                return _facts(found.meta), bytes(found.bytes())
            except BaseError:
                # A range of an empty object is invalid; services refuse it in different ways.
                facts = _facts(obstore.head(self._store, key))
                if facts.size == 0:
                    return facts, b""
                raise
        return None

    def read(self, facts: ObjectFacts, start: int, stop: int) -> bytes:
        """Bytes start … stop−1 of an object, which must be unchanged since `facts` was read.

        Raises StorageError if it was deleted or replaced, CorruptDataError if it is shorter.
        """
        try:
            with self._errors("read", facts.key):
                options: Any = {"range": (start, stop), "if_match": facts.etag or None}
                data = bytes(obstore.get(self._store, facts.key, options=options).bytes())
        except (FileNotFoundError, PreconditionError) as error:
            raise StorageError(
                f"{self.url(facts.key)}: was deleted or replaced while it was read; open it again"
            ) from error
        if len(data) != stop - start:
            raise CorruptDataError(
                f"{self.url(facts.key)}: got {len(data)} bytes, expected {stop - start} from byte "
                f"{start}; the object is truncated, restore it from a copy"
            )
        return data

    def put(self, key: str, content: bytes | Path, *, create: bool = False) -> bool:
        """Write an object; False if `create` is set and it exists already."""
        with self._errors("write", key):
            try:
                obstore.put(self._store, key, content, mode="create" if create else "overwrite")
            except AlreadyExistsError:
                return False
            except FileNotFoundError as error:
                raise StorageError(self._no_bucket(error, key)) from error
        return True

    def list(self, folder: str) -> Iterator[ObjectFacts]:
        """All objects below a prefix, in arbitrary order."""
        with self._errors("list", folder):
            for some in obstore.list(self._store, prefix=folder):
                for found in some:
                    yield _facts(found)

    def folders(self, folder: str) -> builtins.list[str]:
        """Names of the prefixes directly below one; takes one request per 1000."""
        with self._errors("list", folder):
            found = obstore.list_with_delimiter(self._store, prefix=folder)["common_prefixes"]
        return [prefix.rpartition("/")[2] for prefix in found]

    def remove(self, keys: Sequence[str]) -> None:
        """Delete objects; missing ones are ignored."""
        if keys:
            with self._errors("delete", keys[0]):
                obstore.delete(self._store, list(keys))

    def url(self, key: str) -> str:
        """URL of a key, for messages."""
        return f"{self.address}/{key}"

    @contextmanager
    def _errors(self, word: str, key: str) -> Iterator[None]:
        """Map obstore's exceptions to ours; FileNotFoundError and PreconditionError pass through.

        StorageError is a refusal because of credentials, bucket or permissions, UnavailableError no
        answer, or an overloaded service.
        """
        if not _OWNER:
            _OWNER.append(os.getpid())
        if os.getpid() not in _OWNER:
            raise UnavailableError(
                f"{self.url(key)}: object storage was used before this process was forked, which "
                "the connection does not survive; start workers with 'spawn' or 'forkserver' "
                "(DataLoader: multiprocessing_context='spawn')"
            )
        try:
            yield
        except FileNotFoundError as error:
            if "NoSuchBucket" in str(error):
                raise StorageError(self._no_bucket(error, key)) from error
            raise
        except PreconditionError:
            raise
        except (BaseError, OSError, ValueError) as error:
            raise self._translated(error, f"{word} {self.url(key)}") from error

    def _translated(self, error: Exception, what: str) -> StorageError | UnavailableError:
        text = str(error)
        status, code = _STATUS.search(text), _CODE.search(text)
        number = int(status[1]) if status else None
        said = f"{number or ''} {code[1] if code else ''}".strip() or _first_line(error)
        denied = isinstance(error, PermissionDeniedError | UnauthenticatedError)
        if _CREDENTIAL_HOST in text:
            return StorageError(
                f"{what}: no credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or the "
                "storage options access_key_id and secret_access_key"
            )
        if denied or number in {401, 403} or (code is not None and code[1] == "AccessDenied"):
            return StorageError(
                f"{what}: refused ({said}); check the credentials, what they may do, and the region"
            )
        if code is not None and code[1] == "NoSuchBucket":
            return StorageError(self._no_bucket(error, ""))
        if "builder error" in text and self.address.options.allow_http is None:
            return StorageError(f"{what}: an endpoint http://… needs the option allow_http=true")
        if number is None or number >= 500 or number == 429:
            return UnavailableError(
                f"{what}: no answer from the storage service ({said}); check endpoint and "
                "network, then try again"
            )
        return StorageError(f"{what}: refused ({said})")

    def _no_bucket(self, error: Exception, key: str) -> str:
        if "NoSuchBucket" in str(error):
            return f"{self.address}: bucket {self.address.bucket!r} does not exist; create it first"
        return f"{self.url(key)}: refused ({_first_line(error)})"


def _facts(meta: Any) -> ObjectFacts:  # noqa: ANN401 the library's types exist for checkers only
    return ObjectFacts(meta["path"], meta["size"], meta["e_tag"] or "", meta["last_modified"])


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0][:300]
