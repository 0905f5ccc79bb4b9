"""Links of raters: what they allow, when they end, and that agreement is for the lead alone."""

import signal
import sys
from datetime import UTC, datetime, timedelta

import httpx
import pytest
from structlog.testing import capture_logs

from dextouch.serving.running import reload_keys_at_hangup
from services.evaluation.rating import invitations as module
from services.evaluation.rating.app import create_rating_app
from services.evaluation.rating.marks import Mark, MarkLog
from services.evaluation.settings import RatingSettings
from tests.unit.evaluation.test_rating_app import client, given, settings  # noqa: F401

LEAD = {"name": "lead", "key": "the-lead's-own-key-4711", "scopes": ("rate_lead",)}
NEXT, INVITATIONS, AGREEMENT = (
    f"/v1/rating/{name}" for name in ("next", "invitations", "agreement")
)


def bearer(key):
    return {"authorization": f"Bearer {key}"}


BY_LEAD = bearer(LEAD["key"])


async def invited(http, rater="bob", **fields):
    answer = await http.post(INVITATIONS, json={"rater": rater, **fields}, headers=BY_LEAD)
    assert answer.status_code == 201, answer.text
    name, _, secret = answer.json()["link"].removeprefix("/#").partition(":")
    assert name == rater
    return secret


async def refusal(http, secret, rater="bob"):
    answer = await http.get(NEXT, params={"rater": rater}, headers=bearer(secret))
    return answer.status_code, answer.json().get("details", {}).get("reason")


@pytest.fixture
def keyed(settings):  # noqa: F811
    return settings | {"api_keys": (LEAD,)}


async def test_a_link_lets_its_rater_rate_and_nothing_else(keyed):
    async with client(keyed) as http:
        secret = await invited(http)
        shown = (await http.get(NEXT, params={"rater": "bob"}, headers=bearer(secret))).json()
        marked = await http.post(
            "/v1/rating/marks", json=given(shown, rater="bob"), headers=bearer(secret)
        )
        assert marked.status_code == 201, marked.text
        forged = await http.post(
            "/v1/rating/marks", json=given(shown, rater="eve"), headers=bearer(secret)
        )
        assert forged.status_code == 409
        for method, path in (("GET", INVITATIONS), ("POST", INVITATIONS), ("GET", AGREEMENT)):
            body = {"json": {"rater": "eve"}} if method == "POST" else {}
            answer = await http.request(method, path, headers=bearer(secret), **body)
            assert (answer.status_code, answer.json()["details"]["reason"]) == (
                403,
                "missing_scope",
            )
    assert [one.mark.rater for one in MarkLog(keyed["marks"]).history()] == ["bob"]


async def test_a_link_is_refused_when_it_has_ended_was_revoked_or_replaced(keyed, monkeypatch):
    async with client(keyed) as http:
        first = await invited(http)
        second = await invited(http)
        assert await refusal(http, first) == (403, "revoked_link")
        assert (await refusal(http, second))[0] == 200
        revoked = await http.post(f"{INVITATIONS}/bob/revoke", headers=BY_LEAD)
        assert [one["state"] for one in revoked.json()] == ["revoked_link"] * 2
        assert await refusal(http, second) == (403, "revoked_link")
        again = await http.post(f"{INVITATIONS}/bob/revoke", headers=BY_LEAD)
        assert again.status_code == 404
        brief = await invited(http, "carl", days=1 / 86400)
    # The end is stored: neither a restart nor a later clock makes the link good again.
    later = datetime.now(UTC) + timedelta(seconds=2)

    class Later(datetime):
        @classmethod
        def now(cls, tz=None):
            return later.astimezone(tz)

    monkeypatch.setattr(module, "datetime", Later)
    async with client(keyed) as http:
        assert await refusal(http, brief, "carl") == (403, "expired_link")
        listed = (await http.get(INVITATIONS, headers=BY_LEAD)).json()
        assert (listed[0]["rater"], listed[0]["state"]) == ("carl", "expired_link")


async def test_a_link_is_for_the_rollouts_of_one_pool(keyed, tmp_path, monkeypatch):
    """Services with one file of marks: from another folder, with one more rubric, of one task."""
    rubrics = tmp_path / "others.toml"
    rubrics.write_text(keyed["rubrics"].read_text().replace("[reach", "[push"))
    rubrics.write_text(rubrics.read_text() + keyed["rubrics"].read_text())
    async with client(keyed) as http:
        secret = await invited(http)
        assert (await refusal(http, secret))[0] == 200
    monkeypatch.chdir(tmp_path)
    async with client(keyed | {"rubrics": rubrics, "store_url": "store"}) as http:
        assert (await refusal(http, secret))[0] == 200
    async with client(keyed | {"tasks": ("reach",)}) as http:
        assert await refusal(http, secret) == (403, "other_pool")
        assert (await http.get(INVITATIONS, headers=BY_LEAD)).json() == []


async def test_guesses_are_unknown_keys_and_are_limited(keyed):
    async with client(keyed) as http:
        secret = await invited(http)
        assert len(secret) == 43  # 256 bits in base 64
        near = [secret[:-1] + other for other in "AQgw" if other != secret[-1]]
        near += [secret[:-1], secret + "A", secret.swapcase(), f"bob:{secret}"]
        for guess in near:
            assert await refusal(http, guess) == (401, "unknown_key")
        for _ in range(10):
            last = await refusal(http, "guess-" * 7)
        assert last == (429, "too_many_wrong_keys")
        assert (await refusal(http, secret))[0] == 200
    # Neither the secret nor anything it follows from is in the file.
    stored = b"".join(path.read_bytes() for path in keyed["marks"].parent.glob("ratings.sqlite*"))
    assert secret.encode() not in stored


async def test_invitations_need_keys_and_names_of_their_own(keyed, settings, monkeypatch):  # noqa: F811
    async with client(keyed) as http:
        taken = await http.post(INVITATIONS, json={"rater": "lead"}, headers=BY_LEAD)
        assert taken.status_code == 409
        for wrong in ({"rater": "Bob B"}, {"rater": "bob", "days": 0}, {"rater": "b", "days": 91}):
            answer = await http.post(INVITATIONS, json=wrong, headers=BY_LEAD)
            assert answer.status_code == 422
    # A key that the settings got since, and one more rater of its name before.
    monkeypatch.setattr(sys, "stdin", None)
    more = {"name": "p07", "key": "another-key-4711-0815", "scopes": ("rate",)}
    app = create_rating_app(RatingSettings(**keyed))
    before = signal.getsignal(signal.SIGHUP)
    reload_keys_at_hangup(app, lambda: RatingSettings(**keyed | {"api_keys": (LEAD, more)}))
    transport = httpx.ASGITransport(app)
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as http:
        await invited(http, "p07")
        try:
            with capture_logs() as said:
                signal.raise_signal(signal.SIGHUP)
        finally:
            signal.signal(signal.SIGHUP, before)
        assert ("key_names_doubled", ["p07"]) in [(one["event"], one["names"]) for one in said]
        taken = await http.post(INVITATIONS, json={"rater": "p07"}, headers=BY_LEAD)
        assert taken.status_code == 409
    async with client(settings) as http:
        answer = await http.post(INVITATIONS, json={"rater": "bob"})
        assert (answer.status_code, "api_keys" in answer.text) == (409, True)


async def test_agreement_is_told_while_the_rating_runs(keyed):
    async with client(keyed, raters_per_rollout=2) as http:
        before = (await http.get(AGREEMENT, headers=BY_LEAD)).json()
        assert (before["rollouts"], before["tasks"]) == ({"reach": 2}, {})
        for rater, stays in (("ada", True), ("bob", False)):
            for seed in (1, 2):
                holds = {"touched": seed == 1, "stayed": stays}
                one = Mark(rater=rater, holds=holds, episode_id=f"imagined-dream-{seed}")
                MarkLog(keyed["marks"]).add(one)
        now = (await http.get(AGREEMENT, headers=BY_LEAD)).json()["tasks"]["reach"]
    # Scores 1 and 2/3 of the first rollout, 0 and 0 of the second, by `krippendorff` 0.9.0.
    assert now["alpha"] == pytest.approx(8 / 9)
    assert now["alpha_by_criterion"]["touched"] == 1.0
    assert (now["num_rollouts"], now["conflicts"]) == (2, {"open": 2, "settled": 0})
    assert now["marks"] == {"ada": 2, "bob": 2}
