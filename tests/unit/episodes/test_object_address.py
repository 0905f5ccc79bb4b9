"""Addresses and options of buckets, and what is said without the library."""

import sys

import pytest

from dextouch.episodes import EpisodeStore
from dextouch.episodes.s3_bucket import ObjectOptions, parse_address
from dextouch.errors import (
    InvalidInputError,
    UnavailableError,
    UnknownNameError,
)


def test_addresses():
    address = parse_address(
        "s3://takes/a/b%20c/?endpoint=http://h:9000&allow_http=true&work_folder=/w", {}
    )
    assert (address.bucket, address.prefix, str(address)) == ("takes", "a/b c", "s3://takes/a/b c")
    assert address.options.endpoint == "http://h:9000"
    assert str(address.work_folder) == "/w"
    bare = parse_address("s3://takes", {"secret_access_key": "hush"})
    assert (bare.prefix, str(bare)) == ("", "s3://takes")
    assert "hush" not in repr(bare)
    # Two places never share a work folder that nobody chose.
    one, other = (parse_address(f"s3://takes/{p}", {}).work_folder for p in ("a-b", "a/b"))
    assert one != other


@pytest.mark.parametrize(
    "url",
    ["s3://", "s3:///prefix", "s3://b:80/x", "s3://key:hush@b/x", "s3://b/a//c", "s3://b/../c"],
)
def test_addresses_that_are_none(url):
    with pytest.raises(InvalidInputError, match=r"episode store|prefix") as caught:
        EpisodeStore(url)
    assert "hush" not in str(caught.value)


def test_options_that_do_not_fit():
    with pytest.raises(InvalidInputError, match="ends up in logs") as caught:
        EpisodeStore("s3://b/p?secret_access_key=hush")
    assert "hush" not in str(caught.value)
    with pytest.raises(UnknownNameError, match=r"valid: .*endpoint"):
        EpisodeStore("s3://b/p?endpiont=x")
    with pytest.raises(InvalidInputError, match=r"invalid options \['max_retries'\]"):
        EpisodeStore("s3://b/p", {"max_retries": "many"})
    with pytest.raises(InvalidInputError, match="with s3://bucket/prefix only"):
        EpisodeStore("data/store", {"endpoint": "x"})
    assert "hush" not in repr(ObjectOptions.model_validate({"session_token": "hush"}))


def test_without_the_library_the_message_says_what_to_install(monkeypatch):
    for name in list(sys.modules):
        if name.startswith(("obstore", "dextouch.episodes.s3_", "dextouch.episodes.bucket_")):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "obstore", None)
    with pytest.raises(UnavailableError, match=r"needs obstore; run `.*pip install .*\[s3\]"):
        EpisodeStore("s3://bucket/prefix")
