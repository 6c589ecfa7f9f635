"""How the page is served: to those who read HTML, without a token, asking nobody but this host."""

from __future__ import annotations

import re

import httpx
import pytest

from service.viewer import DIST
from tests.service.conftest import is_problem, serving
from worker.settings import Settings

HTML = {"Accept": "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"}


def test_browsers_get_a_page_and_programs_get_links(http: httpx.Client) -> None:
    page = http.get("/", headers=HTML)
    assert page.headers["content-type"].startswith("text/html")
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "http" not in policy
    assert http.get("/").json()["links"]["jobs"] == "/v1/jobs"


@pytest.mark.skipif(not (DIST / "index.html").is_file(), reason="the page was not built here")
def test_the_page_names_bundles_that_are_there_for_good(http: httpx.Client) -> None:
    page = http.get("/", headers=HTML).text
    names = re.findall(r'(?:src|href)="(viewer/[^"]+)"', page)
    assert len(names) == 2
    for name in names:
        bundle = http.get(f"/{name}")
        assert bundle.status_code == 200
        assert "immutable" in bundle.headers["cache-control"]
    assert "https:" not in page


@pytest.mark.parametrize("name", ["nothing.js", "index.html", "sources.sha256", "..%2F__init__.py", "%2e%2e"])
def test_nothing_else_of_the_folder_is_served(http: httpx.Client, name: str) -> None:
    assert http.get(f"/viewer/{name}").status_code == 404


def test_the_built_in_pair_can_be_had_as_files(http: httpx.Client) -> None:
    standing, trotting = (http.get(f"/viewer/creature/{pose}.off").text for pose in ("standing", "trotting"))
    assert standing.startswith("OFF\n")
    assert standing.splitlines()[1] == trotting.splitlines()[1]
    assert standing != trotting
    assert is_problem(http.get("/viewer/creature/flying.off"), 404, "standing, trotting")


def test_the_page_needs_no_token_but_what_it_asks_for_does(lonely: Settings) -> None:
    guarded = Settings(data=lonely.data, redis_url=lonely.redis_url, token="open sesame")
    with serving(guarded) as service, service.client() as http:
        assert http.get("/", headers=HTML).status_code == 200
        assert is_problem(http.get("/"), 401)
        assert is_problem(http.get("/v1/artifacts?kind=mesh", headers=HTML), 401)
