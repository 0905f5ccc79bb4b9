"""Documents as pages: links between them, anchors of headings, and nothing that could run."""

import httpx
import pytest

from dextouch.errors import NotFoundError
from services.dashboard.app import create_app
from services.dashboard.pages import SCREENS, Documents, find_documents
from services.dashboard.settings import DashboardSettings

TEXT = """# First & last

## Signing in, out
See [the other](second.md#its-end), [a decision](decisions/0001-x.md), [code](../README.md) and
[a site](https://example.org/page).

![a chart](pictures/chart.svg)

| a | b |
|---|---|
| 1 | <script>alert(1)</script> |
"""


@pytest.fixture
def documents(tmp_path):
    (tmp_path / "decisions").mkdir()
    (tmp_path / "first.md").write_text(TEXT)
    (tmp_path / "second.md").write_text("# Second\n\n## Its end\n")
    (tmp_path / "decisions" / "0001-x.md").write_text("# X\n\nBack to [first](../first.md).\n")
    return Documents(tmp_path)


def test_links_lead_to_documents_and_nothing_runs(documents):
    found = documents.read("first")
    assert documents.titles == {"first": "First & last", "second": "Second"}
    for expected in (
        "<h1",
        '<h2 id="signing-in-out">Signing in, out</h2>',
        '<a href="/help/second#its-end">the other</a>',
        '<a href="/help/decisions/0001-x">a decision</a>',
        "<a>code</a>",
        '<a href="https://example.org/page" rel="noreferrer">a site</a>',
        "a chart",
        "<td>&lt;script&gt;alert(1)&lt;/script&gt;</td>",
    ):
        assert expected in found
    assert "<img" not in found
    assert '<a href="/help/first">first</a>' in documents.read("decisions/0001-x")


@pytest.mark.parametrize("name", ["third", "../secret", "", "first.md"])
def test_only_documents_of_the_folder_are_read(documents, tmp_path, name):
    (tmp_path.parent / "secret.md").write_text("# Secret")
    with pytest.raises(NotFoundError, match="not one of this release"):
        documents.read(name)


def test_every_screen_has_a_section_in_the_document_of_the_dashboard():
    html = Documents(find_documents()).read("dashboard")
    for screen in SCREENS:
        assert not screen.help or f'id="{screen.help}"' in html
    assert sum(bool(screen.help) for screen in SCREENS) == len(SCREENS) - 1


async def test_help_and_errors_are_pages_of_the_dashboard():
    settings = DashboardSettings(station="one", acquisition_url="http://127.0.0.1:9")
    transport = httpx.ASGITransport(app=create_app(settings))
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        page = await client.get("/health?station=one")
        assert 'href="/help/dashboard?station=one#health"' in page.text
        assert 'href="/calibration?station=one"' in page.text
        assert "<h2" in (await client.get("/help/dashboard")).text
        for path in ("/nothing", "/?station=two", "/help/nothing"):
            answer = await client.get(path, headers={"accept": "text/html"})
            assert answer.status_code == 404
            assert answer.headers["content-type"].startswith("text/html")
            assert "default-src 'none'" in answer.headers["content-security-policy"]
            assert 'href="/"' in answer.text
            assert (await client.get(path)).json()["status"] == 404
