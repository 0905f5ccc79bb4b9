"""Secrets of settings that turn up in a text are hidden there."""

import secrets

import pytest
from pydantic import BaseModel, SecretStr

from dextouch.serving import logs
from dextouch.serving.logs import hide_secrets, masked


class Inner(BaseModel):
    key: SecretStr


class Outer(BaseModel):
    keys: tuple[Inner, ...]
    by_name: dict[str, Inner]
    state_url: str = "memory://"
    short: SecretStr = SecretStr("the")


@pytest.fixture(autouse=True)
def _forgotten(monkeypatch):
    monkeypatch.setattr(logs, "_secrets", {})


def settings(key, **more):
    return Outer(keys=(Inner(key=key),), by_name={"a": Inner(key="of-the-mapping")}, **more)


def test_every_form_of_a_secret_is_hidden():
    hide_secrets(settings('a "b"/c\\d-e', state_url="redis://me:pass-word-1@host:1/0"))
    text = r'of-the-mapping a "b"/c\d-e a%20%22b%22%2Fc%5Cd-e a \"b\"/c\\d-e'
    assert masked(text) == "*** *** *** ***"
    assert masked("redis://me:pass-word-1@host") == "redis://me:***@host"


def test_a_secret_that_holds_another_is_hidden_as_a_whole():
    hide_secrets(settings("of-the-mapping-and-more"))
    assert masked("of-the-mapping-and-more") == "***"


def test_ordinary_words_stay():
    hide_secrets(settings("of-the-tuple"))
    assert masked("the mapping of memory://") == "the mapping of memory://"


def test_secrets_of_all_services_of_a_process_are_hidden():
    hide_secrets(settings("of-the-first"))
    hide_secrets(settings("of-the-other"))
    assert masked("of-the-first of-the-other") == "*** ***"


def test_keys_that_no_service_knows_are_hidden_by_their_shape():
    issued = [secrets.token_urlsafe(32) for _ in range(200)]
    assert [masked(f"/v1/episodes/{key}?x") for key in issued].count("/v1/episodes/***?x") >= 198
    assert masked('{"request_id": "OFg77JhGsnxhA7KNGv7OGUSxqffmEYi3YGvKPreDGv4"}').endswith(
        '"***"}'
    )


@pytest.mark.parametrize(
    "name",
    [
        "take_with_a_very_long_name_of_43_letters_01",
        "a" * 43,
        "0123456789abcdef" * 4,
        "Take-20261128-112753-abc123",
        "3f0c1a2b-aaaa-4bbb-8ccc-0123456789AB",
    ],
)
def test_names_are_not_hidden(name):
    assert masked(f"episode {name} not found") == f"episode {name} not found"
