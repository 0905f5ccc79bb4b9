"""Which keys settings accept, and that a refusal says how to make one without repeating the key."""

import re
import secrets
import string
from pathlib import Path

import pytest

from dextouch.errors import InvalidInputError
from dextouch.serving import ServiceSettings, load_settings

ROOT = Path(__file__).parents[3]
WEAK = [
    "1111111111111111",
    "0" * 64,
    "aaaaaaaaaaaaaaab",
    "abababababababab",
    "abcabcabcabcabca",
    "deadbeefdeadbeefdeadbeef",
    "passwordpassword",
    "CHANGE_ME_CHANGE_ME",
    "0123456789abcdef",
    "FEDCBA9876543210",
    "abcdefghijklmnopqrstuvwxyz",
    "12345678901234567890",
    "aabbccddeeffgghh",
    "a1b2c3d4e5f6g7h8",
    "qwertyuiopasdfgh",
    "1q2w3e4r5t6y7u8i",
    "changeme12345678",
    "16 Characters or more",
    "the-key-of-the-store",
]
SHORT = "9f3c1e7ab25d84"
# Made once by `openssl rand -hex 32`, `openssl rand -base64 24`, `pwgen -s 20 1` and `uuidgen`.
STRONG = [
    "6f1b0e9a5c77d2843be08a41f95c2d6e70b3a98d14ce5f62871da0b94e3c6f05",
    "qX8zK1vR+T0bYd7nWm4c/JpEoGhLsU2a",
    "uV3kPz9LxQ7wTn2BcRfY",
    "3f0c8f0e-6a5b-4d0e-9a71-2b8f4f1c7d95",
]


def load(key, monkeypatch, **more):
    monkeypatch.setenv(
        "DEXTOUCH_API_KEYS", f'[{{"name": "desk", "key": "{key}", "scopes": ["station"]}}]'
    )
    return load_settings(ServiceSettings, [])


@pytest.mark.parametrize("key", [*WEAK, SHORT])
def test_a_key_that_can_be_guessed_is_refused(key, monkeypatch):
    with pytest.raises(InvalidInputError, match=r"api_keys\.0\.key: .*openssl rand -hex 32") as no:
        load(key, monkeypatch)
    assert key not in no.value.message


def test_a_key_of_the_configuration_file_is_refused_with_its_line(tmp_path, monkeypatch):
    path = tmp_path / "dextouch.toml"
    path.write_text(
        '[episode_store]\n\napi_keys = [{name = "a", key = "1111111111111111", scopes = ["s"]}]\n'
    )
    monkeypatch.setenv("DEXTOUCH_CONFIG", str(path))
    from services.episode_store.settings import EpisodeStoreSettings

    with pytest.raises(InvalidInputError, match=r"dextouch\.toml:3 .*") as refused:
        load_settings(EpisodeStoreSettings, [])
    assert "openssl rand -hex 32" in refused.value.message
    assert "1111111111111111" not in refused.value.message


@pytest.mark.parametrize("key", STRONG)
def test_random_keys_are_accepted(key, monkeypatch):
    assert load(key, monkeypatch).api_keys[0].key.get_secret_value() == key


@pytest.mark.long
def test_no_key_of_the_documented_command_is_refused(monkeypatch):
    for _ in range(500):
        load(secrets.token_hex(32), monkeypatch)
        load("".join(secrets.choice(string.ascii_letters) for _ in range(24)), monkeypatch)


def test_no_page_shows_a_key_that_settings_would_accept(monkeypatch):
    """People copy what is printed: a literal key in a page must be refused."""
    pages = [
        ROOT / "README.md",
        ROOT / "docker-compose.yml",
        *sorted((ROOT / "docs").rglob("*.md")),
    ]
    literal = re.compile(r"""\bkey"?\s*[=:]\s*"([^"]+)"|\w+_KEY=([\w-]+)""", re.IGNORECASE)
    for page in pages:
        for match in literal.finditer(page.read_text()):
            key = match[1] or match[2]
            if not key.startswith("$"):
                with pytest.raises(InvalidInputError):
                    load(key, monkeypatch)
