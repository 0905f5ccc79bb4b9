"""Wrong keys are slowed down, valid ones never; refusals leave lines in the log, but no flood."""

import httpx
import pytest
from fastapi import APIRouter, Depends
from structlog.testing import capture_logs

from dextouch.serving import RequireScope, ServiceSettings, create_service_app
from dextouch.serving.keys import ApiKey
from dextouch.serving.refusals import MAX_ADDRESSES, MAX_LINES, RateLimit, RefusalLog, WrongKeys
from services.dashboard.app import create_app
from services.dashboard.settings import DashboardSettings
from tests.contracts.service_apps import open_websocket

KEY = "a-key-of-some-length"
KEYS = (ApiKey(name="desk", key=KEY, scopes=("rollout", "operate")),)


class Clock:
    now_s = 1000.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


def probe_app(clock, **settings):
    router = APIRouter()

    @router.get("/guarded", dependencies=[Depends(RequireScope("rollout"))])
    async def guarded() -> str:
        return "in"

    made = ServiceSettings.model_validate({"api_keys": KEYS} | settings)
    app = create_service_app(name="probe", settings=made, routers=[router])
    app.state.wrong_keys._limit = RateLimit(clock_s=clock)
    app.state.refusals._limit = RateLimit(MAX_LINES, clock_s=clock)
    return app


def from_(address, app):
    transport = httpx.ASGITransport(app, client=(address, 4000))
    return httpx.AsyncClient(transport=transport, base_url="http://localhost")


async def ask(app, address, key, kind="Bearer", **headers):
    async with from_(address, app) as client:
        given = {"authorization": f"{kind} {key}"} | headers
        return await client.get("/guarded", headers=given)


async def guess(app, address, times, first=0):
    keys = [f"wrong-{number:020}" for number in range(first, first + times)]
    return [(await ask(app, address, key)).status_code for key in keys]


@pytest.mark.parametrize("kind", ["Bearer", "Api-Key"])
async def test_an_address_that_guesses_is_slowed_and_a_valid_key_is_not(clock, kind):
    app = probe_app(clock)
    assert await guess(app, "10.0.0.9", 40) == [401] * 10 + [429] * 30
    refused = await ask(app, "10.0.0.9", "wrong-one", kind)
    # One in six seconds of ten in a minute.
    assert (refused.status_code, refused.headers["retry-after"]) == (429, "7")
    assert refused.json()["details"]["reason"] == "too_many_wrong_keys"
    assert (await ask(app, "10.0.0.9", KEY, kind)).status_code == 200
    # Others can mistype a key, too.
    assert await guess(app, "10.0.0.10", 1) == [401]
    clock.now_s += 12.1
    assert await guess(app, "10.0.0.9", 3) == [401, 401, 429]


@pytest.mark.long
async def test_all_addresses_together_are_slowed_and_a_valid_key_is_not(clock):
    app = probe_app(clock)
    found = []
    for number in range(40):
        found += await guess(app, f"10.0.{number}.1", 5)
    assert found == [401] * 100 + [429] * 100
    assert (await ask(app, "10.0.7.1", KEY)).status_code == 200


@pytest.mark.long
async def test_an_address_that_goes_on_guessing_does_not_use_up_the_share_of_others(clock):
    app = probe_app(clock)
    await guess(app, "10.0.0.9", 300)
    assert await guess(app, "10.0.0.10", 5) == [401] * 5


async def test_an_ipv6_network_is_one_caller(clock):
    app = probe_app(clock)
    found = [(await guess(app, f"2001:db8:0:7::{number:x}", 1))[0] for number in range(20)]
    assert found == [401] * 10 + [429] * 10
    assert await guess(app, "2001:db8:0:8::1", 1) == [401]


def test_memory_of_addresses_is_bounded(clock):
    limit = RateLimit(overall=10**9, clock_s=clock)
    for number in range(2 * MAX_ADDRESSES):
        limit.wait_s(f"10.{number >> 16}.{number >> 8 & 255}.{number & 255}")
    assert len(limit._buckets) == MAX_ADDRESSES


async def test_a_request_without_a_key_is_no_guess(clock):
    app = probe_app(clock)
    async with from_("10.0.0.9", app) as client:
        for _ in range(50):
            assert (await client.get("/guarded")).status_code == 401
    assert await guess(app, "10.0.0.9", 1) == [401]


async def test_websockets_are_slowed_too(clock):
    app = probe_app(clock)
    headers = {"authorization": "Bearer wrong"}
    refused = [await open_websocket(app, "/v1/any", headers=headers) for _ in range(11)]
    assert all(one["code"] == 1008 for one in refused)
    assert [one["reason"].startswith("unknown key, one of too many") for one in refused] == [
        *[False] * 10,
        True,
    ]
    assert await guess(app, "unknown", 1) == [429]


async def test_sign_ins_are_slowed_and_a_valid_key_is_not():
    app = create_app(DashboardSettings(api_keys=KEYS), {})
    async with from_("10.0.0.9", app) as client:

        async def sign_in(key):
            return await client.post("/sign_in", data={"key": key})

        found = [await sign_in(f"wrong-{number:020}") for number in range(200)]
        assert [one.status_code for one in found] == [401] * 10 + [429] * 190
        assert int(found[-1].headers["retry-after"]) <= 7
        assert "too many" in found[-1].text
        assert 'action="/sign_in"' in found[-1].text
        assert (await sign_in(KEY)).status_code == 303


async def test_a_browser_that_is_signed_in_is_not_refused_for_the_key_of_another_proxy():
    app = create_app(DashboardSettings(api_keys=KEYS), {})
    async with from_("10.0.0.9", app) as client:
        assert (await client.post("/sign_in", data={"key": KEY})).status_code == 303
        other = {"authorization": "Bearer of-a-proxy-that-knows-people"}
        found = [(await client.get("/v1/overview", headers=other)).status_code for _ in range(20)]
    assert found == [200] * 20


async def test_a_refused_caller_leaves_one_line(clock):
    app = probe_app(clock)
    with capture_logs() as logs:
        await ask(app, "10.0.0.9", "wrong-key-of-some-length")
        await ask(app, "10.0.0.9", KEY, origin="http://evil.example")
    (line,) = [one for one in logs if one["event"] == "request_refused"]
    known = {"method": "GET", "path": "/guarded", "client": "10.0.0.9", "status": 401}
    assert known.items() <= line.items()
    assert (line["reason"], line["log_level"]) == ("unknown_key", "warning")
    assert "wrong-key" not in str(logs)


async def test_a_key_that_is_also_in_the_path_is_not_logged(clock):
    app = probe_app(clock)
    async with from_("10.0.0.9", app) as client:
        with capture_logs() as logs:
            given = {"authorization": "Bearer wrong-key-of-some-length"}
            await client.post("/v1/wrong-key-of-some-length", headers=given)
    assert [one["path"] for one in logs] == ["/v1/***"]


async def test_the_line_names_the_key_that_lacks_a_scope(clock):
    reader = ApiKey(name="reader", key="another-key-of-length", scopes=("store_read",))
    app = probe_app(clock, api_keys=(reader,))
    with capture_logs() as logs:
        assert (await ask(app, "10.0.0.9", "another-key-of-length")).status_code == 403
    assert [(one["key"], one["reason"]) for one in logs] == [("reader", "missing_scope")]


async def test_pages_of_other_sites_and_foreign_hosts_leave_a_line():
    app = create_app(DashboardSettings(), {})
    async with from_("10.0.0.9", app) as client:
        with capture_logs() as logs:
            evil = {"origin": "http://evil.example"}
            assert (await client.post("/sign_out", headers=evil)).status_code == 403
            assert (await client.get("/", headers={"host": "evil.example"})).status_code == 421
    found = [(one["status"], one["reason"]) for one in logs if one["event"] == "request_refused"]
    assert found == [(403, "foreign_origin"), (421, "foreign_host")]


@pytest.mark.long
async def test_a_flood_is_counted_rather_than_logged(clock):
    app = probe_app(clock)
    with capture_logs() as logs:
        await guess(app, "10.0.0.9", 500)
        assert [one["status"] for one in logs] == [401] * 5 + [429] * 5
        # Neither another caller nor another kind is hidden by it.
        await guess(app, "10.0.0.10", 1)
        clock.now_s += 12.1
        await guess(app, "10.0.0.9", 1)
    assert len(logs) == 12
    # 502 refusals in all.
    assert sum(one.get("num_not_logged", 0) for one in logs) == 502 - 12


def test_many_callers_leave_a_bounded_number_of_lines(clock):
    log = RefusalLog(limit=RateLimit(clock_s=clock))
    with capture_logs() as logs:
        for number in range(5000):
            log.note_caller(f"10.1.{number >> 8}.{number & 255}", 401, "unknown_key")
    assert len(logs) == 100


def test_wrong_keys_has_a_limit_of_its_own():
    assert WrongKeys()._limit is not WrongKeys()._limit


async def proxied(app, address, **headers):
    key = "wrong-key-of-some-length"
    with capture_logs() as logs:
        await ask(app, address, key, **headers)
    return logs[0]["client"]


async def test_without_the_setting_no_proxy_is_believed(clock):
    app = probe_app(clock)
    for address in ("127.0.0.1", "10.0.0.9"):
        assert await proxied(app, address, **{"x-forwarded-for": "1.2.3.4"}) == address


@pytest.mark.parametrize(
    ("sent", "found"),
    [
        ("203.0.113.5", "203.0.113.5"),
        # What the client itself sent comes first, and is not believed.
        ("9.9.9.9, 203.0.113.5", "203.0.113.5"),
        ("9.9.9.9, 203.0.113.5, 10.1.2.3", "203.0.113.5"),
        ("203.0.113.5:4711", "203.0.113.5"),
        ("[2001:db8::7]:4711", "2001:db8::7"),
    ],
)
async def test_the_address_of_a_client_behind_trusted_proxies(clock, sent, found):
    app = probe_app(clock, trusted_proxies=("192.0.2.7", "10.1.0.0/16"))
    assert await proxied(app, "192.0.2.7", **{"x-forwarded-for": sent}) == found
    assert await proxied(app, "10.1.9.9", **{"x-forwarded-for": sent}) == found
    assert await proxied(app, "192.0.2.8", **{"x-forwarded-for": sent}) == "192.0.2.8"


@pytest.mark.parametrize("wrong", ["*", "proxy.lab", "10.0.0.7/24", "10.0.0.0/33", "", "10.0.0"])
def test_networks_that_would_match_nothing_or_everything_are_refused(wrong):
    with pytest.raises(ValueError, match=r"10\.0\.0\.0/24"):
        ServiceSettings(trusted_proxies=(wrong,))


@pytest.mark.parametrize(
    ("address", "headers", "is_secure"),
    [
        ("192.0.2.7", {"x-forwarded-proto": "https"}, True),
        ("192.0.2.7", {"x-forwarded-proto": "http"}, False),
        ("192.0.2.7", {}, False),
        ("192.0.2.8", {"x-forwarded-proto": "https"}, False),
    ],
)
async def test_cookies_are_secure_behind_tls(address, headers, is_secure, tmp_path):
    settings = DashboardSettings(
        api_keys=KEYS, trusted_proxies=("192.0.2.7",), audit_folder=tmp_path
    )
    headers = headers | {"x-forwarded-for": "203.0.113.5"}
    async with from_(address, create_app(settings, {})) as client:
        answer = await client.post("/sign_in", data={"key": KEY}, headers=headers)
    assert answer.status_code == 303
    assert ("; Secure" in answer.headers["set-cookie"]) is is_secure
    # The audit log names the same client.
    (log,) = tmp_path.glob("*.jsonl")
    caller = "203.0.113.5" if address == "192.0.2.7" else address
    assert f'"client":"{caller}"' in log.read_text()
