"""The files of the operators' page, as a browser gets them."""

from __future__ import annotations

import gzip
import hashlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from fastapi.testclient import TestClient

from loopwright.service.api.gate.gate import Policy
from loopwright.service.api.web.compressed import TEXTS, compressed
from loopwright.service.api.web.pages import FILES
from loopwright.service.security.keys import Scope
from loopwright.service.store.keyring import Keyring
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import TAG, Service

VENDOR = FILES / "vendor"
OURS = sorted(path for path in FILES.rglob("*") if path.is_file() and VENDOR not in path.parents)


@pytest.fixture
def client(service: Service) -> Iterator[TestClient]:
    with TestClient(app_of(service.jobs)) as client:
        yield client


@pytest.mark.parametrize(
    "path",
    [
        "/", "/ui", "/ui/", f"/ui/loops/{TAG}", "/ui/loops/10.FIC-101.js", "/ui/jobs/4f0c2a9be113", "/ui/index.html",
    ],
)  # fmt: skip
def test_every_place_is_answered_with_the_page(client: TestClient, path: str) -> None:
    answer = client.get(path)
    assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/html")
    assert answer.text == (FILES / "index.html").read_text()


def test_the_policy_lets_nothing_in_from_elsewhere(client: TestClient) -> None:
    for path in ("/ui/", "/ui/js/main.js", "/ui/app.css"):
        policy = client.get(path).headers["content-security-policy"].split("; ")
        assert {"default-src 'none'", "script-src 'self'", "style-src 'self'", "connect-src 'self'"} <= set(policy)
        assert {"frame-ancestors 'none'", "base-uri 'none'", "trusted-types 'none'"} <= set(policy)
        assert not re.search(r"unsafe|https?:|\*", " ".join(policy))
        assert client.get(path).headers["x-content-type-options"] == "nosniff"


def test_a_file_that_did_not_change_is_not_sent_again(client: TestClient) -> None:
    first = client.get("/ui/js/main.js")
    assert first.headers["content-type"].partition(";")[0] in ("text/javascript", "application/javascript")
    assert first.headers["cache-control"] == "no-cache"
    again = client.get("/ui/js/main.js", headers={"If-None-Match": first.headers["etag"]})
    assert again.status_code == 304 and not again.content
    assert again.headers["content-security-policy"] == first.headers["content-security-policy"]


def sent(client: TestClient, path: str, accepted: str, **headers: str) -> tuple[bytes, httpx.Headers, int]:
    """The bytes of an answer as they come over the wire, its headers, its status."""
    with client.stream("GET", path, headers={"Accept-Encoding": accepted, **headers}) as answer:
        return b"".join(answer.iter_raw()), answer.headers, answer.status_code


@pytest.mark.parametrize("path", ["/ui/", "/ui/js/main.js", "/ui/app.css", "/ui/icon.svg", "/ui/vendor/uPlot.js"])
def test_text_is_sent_compressed_to_who_takes_it(client: TestClient, path: str) -> None:
    file = FILES / (path.removeprefix("/ui/") or "index.html")
    packed, headers, _ = sent(client, path, "gzip, deflate, br")
    assert headers["content-encoding"] == "gzip" and int(headers["content-length"]) == len(packed)
    assert gzip.decompress(packed) == file.read_bytes()
    plain, plainly, _ = sent(client, path, "gzip;q=0, identity")
    assert "content-encoding" not in plainly and plain == file.read_bytes()
    assert headers["vary"] == plainly["vary"] == "Accept-Encoding"
    for name in ("content-type", "content-security-policy", "etag"):
        assert headers[name] == plainly[name]


def test_a_browser_that_has_a_text_is_not_sent_it_again_in_either_form(client: TestClient) -> None:
    for had in ("gzip", "identity"):
        _, headers, _ = sent(client, "/ui/js/main.js", had)
        assert headers["etag"].startswith('W/"')  # one for both forms, which differ in their bytes
        for asked in ("gzip", "identity"):
            body, again, status = sent(client, "/ui/js/main.js", asked, **{"If-None-Match": headers["etag"]})
            assert status == 304 and not body and again["etag"] == headers["etag"]
            assert again["vary"] == "Accept-Encoding"


def test_other_files_are_sent_as_they_are(client: TestClient) -> None:
    others = [path for path in FILES.rglob("*") if path.is_file() and path.suffix not in TEXTS]
    assert others
    for file in others:
        body, headers, _ = sent(client, f"/ui/{file.relative_to(FILES)}", "gzip")
        assert "content-encoding" not in headers and body == file.read_bytes()


def test_a_text_is_compressed_once_and_anew_when_it_has_changed(tmp_path: Path) -> None:
    file = tmp_path / "text.js"
    file.write_text("const first = 1;")
    os.utime(file, ns=(1, 1))
    once = compressed(file)
    assert compressed(file) is once and gzip.decompress(once) == b"const first = 1;"
    file.write_text("const other = 2;")
    os.utime(file, ns=(2, 2))
    assert gzip.decompress(compressed(file)) == b"const other = 2;"


def test_the_page_is_small_enough_for_a_slow_line() -> None:
    """All that a first visit brings, compressed: well under 300 kB, which `make bench` measures in the browser."""
    files = [path for path in FILES.rglob("*.*") if path.name not in ("VERSIONS", "LICENSES")]
    assert sum(len(compressed(path)) if path.suffix in TEXTS else path.stat().st_size for path in files) < 300_000


@pytest.mark.parametrize(
    "path", ["/ui/js/none.js", "/ui/../pages.py", "/ui/%2e%2e/pages.py", "/ui/..%2fpages.py", "/ui/js/../../pages.py"]
)
def test_only_files_of_the_page_are_sent(client: TestClient, path: str) -> None:
    answer = client.get(path)
    assert answer.status_code == 404 and "StaticFiles" not in answer.text


def test_where_keys_are_asked_for_the_page_comes_without_one(service: Service) -> None:
    with TestClient(app_of(service.jobs, Policy(Keyring(service.store.engine)))) as client:
        for path in ("/", "/ui", "/ui/", f"/ui/loops/{TAG}", "/ui/js/main.js"):
            assert client.get(path).status_code == 200
        assert client.post("/ui/").status_code == 405
        assert client.get("/ui/../loops").status_code == client.get("/uix").status_code == 401


def test_the_page_learns_who_is_asking(service: Service, client: TestClient) -> None:
    found = client.get("/session").json()
    assert (found["name"], found["scope"], found["keys"], found["gateway"]) == ("local", "admin", False, "local")
    keyring = Keyring(service.store.engine)
    _, key = keyring.create("control room", Scope.OPERATE)
    with TestClient(app_of(service.jobs, Policy(keyring))) as keyed:
        assert keyed.get("/session").status_code == 401
        found = keyed.get("/session", headers={"Authorization": f"Bearer {key}"}).json()
        assert (found["name"], found["scope"], found["keys"]) == ("control room", "operate", True)


def test_the_libraries_are_those_of_the_list() -> None:
    listed = dict(line.split()[:1] + line.split()[-1:] for line in (VENDOR / "VERSIONS").read_text().splitlines())
    files = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in VENDOR.iterdir()}
    licences = files.pop("LICENSES"), files.pop("VERSIONS")
    assert all(licences) and files == listed
    text = (VENDOR / "LICENSES").read_text()
    for line in (VENDOR / "VERSIONS").read_text().splitlines():
        assert f"{line.split()[1]} {line.split()[2]}" in text


@pytest.mark.parametrize("path", OURS, ids=lambda path: path.name)
def test_our_files_ask_for_nothing_from_elsewhere(path: str) -> None:
    text = (FILES / path).read_text()
    assert not re.search(r"(?:https?:)?//[a-z0-9-]+\.[a-z]{2,}", text.replace("http://www.w3.org/2000/svg", ""))
    assert "innerHTML" not in text and "eval(" not in text


@pytest.mark.parametrize("path", [path for path in OURS if path.suffix == ".js"], ids=lambda path: path.name)
def test_every_module_that_is_imported_exists(path: str) -> None:
    module = FILES / path
    for name in re.findall(r"""(?:from|import)\s+["']([^"']+)["']""", module.read_text()):
        assert name.startswith("."), f"a browser does not resolve the bare name {name}"
        assert (module.parent / name).resolve().is_file(), name
