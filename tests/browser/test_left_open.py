"""A page that stays open while others lock loops, other limits are configured, and connections die without a word.

The loop and its controller are simulated; the API behind the page is the real one."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from playwright.sync_api import Route, expect

from loopwright.service.api.app import create_app
from loopwright.service.inputs.request import FastRetune
from loopwright.service.live.messages import RETRY_MS
from tests.browser import person
from tests.browser.pages import Pages
from tests.unit.service.fakes import TAG, Service
from tests.unit.service.processes import until
from tests.unit.service.served import served

LOOP = f"/ui/loops/{TAG}"
OTHER = "FIC-2"


@dataclass
class SimulatedSite:
    """A service with two loops, and its address."""

    url: str
    service: Service


@pytest.fixture
def site(tmp_path: Path) -> Iterator[SimulatedSite]:
    service = Service(tmp_path)
    with served(create_app(service.jobs)) as server:
        yield SimulatedSite(f"http://127.0.0.1:{server.port}", service)
    service.close()


def proposal(service: Service, tag: str = TAG) -> str:
    """The id of a job whose proposal waits for a decision."""
    service.tune.hold.set()
    job_id = service.jobs.start(tag, FastRetune(requested_by=person.NAME)).id
    service.wait(job_id)
    return job_id


class TestAbort:
    def test_it_is_not_said_to_be_heard_before_the_service_says_so(self, site: SimulatedSite, pages: Pages) -> None:
        page = pages.open(LOOP)
        job_id = site.service.under_test()
        held: list[Route] = []
        page.route("**/abort", lambda route: held.append(route))
        person.abort_button(page).click()
        dock = person.dock(page)
        expect(dock).to_contain_text("abort sent, no answer yet")
        expect(dock.get_by_role("alert")).to_have_text(
            "Abort not confirmed: The service has not answered within 10 s: it is not known whether it has heard this."
        )
        expect(dock).not_to_contain_text("restored")
        page.unroute("**/abort")
        running = site.service.jobs.running(job_id)
        assert held and running is not None and running.stop_reason is None
        person.abort_button(page).click()  # again
        expect(dock).to_contain_text("stopping, the loop is being restored")
        assert running.stop_reason is not None

    def test_it_is_heard_from_one_of_many_windows_of_a_browser(self, site: SimulatedSite, pages: Pages) -> None:
        """A browser makes six connections to a service, and the stream of each window takes one."""
        context = pages.context()
        windows = [pages.another(context, LOOP) for _ in range(6)]
        job_id = site.service.under_test()
        for page in windows:
            expect(person.abort_button(page)).to_be_enabled()
        person.abort_button(windows[-1]).click()
        running = site.service.jobs.running(job_id)
        assert running is not None
        until(lambda: running.stop_reason is not None, "the abort")
        expect(person.dock(windows[0])).not_to_be_attached()

    def test_that_it_is_stored_is_not_said_to_be_heard_by_a_gateway_that_is_silent(
        self, site: SimulatedSite, pages: Pages
    ) -> None:
        job = {
            "id": "4f0c2a9be113", "url": "/jobs/4f0c2a9be113", "loop": TAG, "host": "gw-2", "state": "running",
            "dry_run": False, "requested_by": "A. Lind", "stage": "relay", "progress": None,
            "remaining_plant_time_s": None, "plant_time_s": 0.0, "stopping": True,
        }  # fmt: skip
        hello = {"host": "local", "version": "0.1.0", "now_s": 1769860830.5, "loops": [], "back_s": 10.0}
        said = {"hello": hello, "jobs": {"jobs": [job]}}
        text = f"retry: {RETRY_MS}\n" + "".join(
            f"event: {name}\ndata: {json.dumps(data)}\n\n" for name, data in said.items()
        )
        page = pages.open("/ui/jobs")
        page.route("**/live*", lambda route: route.fulfill(body=text, content_type="text/event-stream"))
        page.reload()
        dock = person.dock(page)
        expect(dock).to_contain_text("asked to stop, gateway gw-2 has not said that it has heard")
        expect(dock).not_to_contain_text("restored")

    def test_it_is_not_refused_for_the_session_of_another_window(self, site: SimulatedSite, pages: Pages) -> None:
        """Somebody has signed in anew in another window: the cookie is another one, and what is shown beside it too."""
        page = pages.open(LOOP)
        job_id = site.service.under_test()
        shown: list[str | None] = []

        def refused_once(route: Route) -> None:
            shown.append(route.request.header_value("X-Loopwright-CSRF"))
            if len(shown) == 1:
                route.fulfill(status=403, json={"detail": "this request needs the header X-Loopwright-CSRF"})
            else:
                route.continue_()

        page.route("**/abort", refused_once)
        session = {"name": "control room", "scope": "operate", "keys": True, "csrf": "of the new session"}
        page.route("**/session", lambda route: route.fulfill(json=session))
        with pages.expecting("status of 403"):
            person.abort_button(page).click()
        running = site.service.jobs.running(job_id)
        until(lambda: running is None or running.stop_reason is not None, "the abort")
        assert shown == [None, "of the new session"]
