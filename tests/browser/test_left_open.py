"""A page that stays open while others lock loops, other limits are configured, and connections die without a word.

The loop and its controller are simulated; the API behind the page is the real one."""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, Route, expect
from sqlalchemy import delete

from loopwright.service.inputs.config import parse_site
from loopwright.service.inputs.request import FastRetune
from loopwright.service.live.jobs import LookedUpJobs
from loopwright.service.live.messages import RETRY_MS
from loopwright.service.store.tables import LoopRow
from loopwright.tuning.reasons import Failed, Reason
from tests.browser import person
from tests.browser.pages import Pages
from tests.browser.test_clock import HIDE
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import TAG, FakeLoop, Service, loop_entry
from tests.unit.service.processes import until
from tests.unit.service.served import served

LOOP = f"/ui/loops/{TAG}"
OTHER = "FIC-2"
LIVE_JOB: dict[str, Any] = {
    "id": "4f0c2a9be113", "url": "/jobs/4f0c2a9be113", "loop": TAG, "gateway": "gw-2", "state": "running",
    "dry_run": False, "by": "A. Lind", "stage": "relay", "progress": None, "remaining_plant_time_s": None,
    "plant_time_s": 0.0, "stopping": True,
}  # fmt: skip
"""Of a gateway that says nothing."""


@dataclass
class SimulatedSite:
    """A service with two loops, and its address."""

    url: str
    service: Service


@pytest.fixture
def site(tmp_path: Path) -> Iterator[SimulatedSite]:
    service = Service(tmp_path)
    with served(app_of(service.jobs)) as server:
        yield SimulatedSite(f"http://127.0.0.1:{server.port}", service)
    service.close()


def proposal(service: Service, tag: str = TAG) -> str:
    """The id of a job whose proposal waits for a decision."""
    service.tune.hold.set()
    job_id = service.jobs.start(tag, FastRetune(by=person.NAME)).id
    service.wait(job_id)
    return job_id


def stream(**said: Any) -> str:
    """A live stream that says this and ends."""
    return f"retry: {RETRY_MS}\n" + "".join(
        f"event: {name}\ndata: {json.dumps(data)}\n\n" for name, data in said.items()
    )


class TestWhatOthersDo:
    def test_a_lock_and_its_end_are_seen(self, site: SimulatedSite, pages: Pages) -> None:
        proposal(site.service)
        page = pages.open(LOOP)
        accept = page.get_by_role("button", name="Accept the new gains")
        expect(accept).to_be_enabled()
        site.service.jobs.locking.lock(TAG, "valve is being overhauled", "night shift")
        expect(page.get_by_text("Locked by night shift since")).to_be_visible()
        expect(accept).not_to_be_attached()
        site.service.jobs.locking.unlock(TAG, "night shift")
        expect(accept).to_be_enabled()

    def test_the_end_of_a_lock_is_seen_also_where_the_stream_never_said_that_there_was_one(
        self, site: SimulatedSite, pages: Pages, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The stream looks once a second; the page asked for the loops just between lock and unlock."""
        look = LookedUpJobs.look

        def without_locks(found: LookedUpJobs, watched: Collection[str], thoroughly: bool) -> None:
            look(found, watched, thoroughly)
            found.locked = {}

        monkeypatch.setattr(LookedUpJobs, "look", without_locks)
        proposal(site.service)
        page = pages.open(LOOP)
        accept = page.get_by_role("button", name="Accept the new gains")
        expect(accept).to_be_enabled()
        site.service.jobs.locking.lock(TAG, "valve is being overhauled", "night shift")
        proposal(site.service, OTHER)  # for which the page asks for the loops
        expect(page.get_by_text("Locked by night shift since")).to_be_visible()
        site.service.jobs.locking.unlock(TAG, "night shift")
        expect(accept).to_be_enabled()

    def test_a_decision_is_seen_in_the_list_of_jobs(self, site: SimulatedSite, pages: Pages) -> None:
        job_id = proposal(site.service)
        page = pages.open("/ui/jobs")
        expect(page.get_by_role("row", name=TAG)).to_contain_text("awaiting decision")
        site.service.jobs.decisions.rollback(job_id, "B. Roth")
        expect(page.get_by_role("row", name=TAG)).to_contain_text("B. Roth")

    def test_what_was_known_before_a_later_test_is_not_shown_as_known_now(
        self, site: SimulatedSite, pages: Pages
    ) -> None:
        page = pages.open(LOOP)
        known = page.get_by_role("region", name="Process model")
        found = {
            "knowledge": {"Ms": 1.61, "uncertainty": 0.02, "model": {"dead_time_s": 2.0}, "changes": 3, "consistent": 0,
                          "text": "Ms known"},
            "known": "", "detail": "", "advice": None, "changes_used": [], "changes_dropped": [], "loads": [],
        }  # fmt: skip
        page.route("**/observation", lambda route: route.fulfill(json=found))
        page.get_by_role("button", name="Identify from operation").click()
        expect(known).to_contain_text("1.61")
        proposal(site.service)
        expect(known).not_to_contain_text("1.61")


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
            "Abort not confirmed: The service has not answered within 10 s: it is not known whether it has received "
            "this."
        )
        expect(dock).not_to_contain_text("restored")
        page.unroute("**/abort")
        running = site.service.jobs.running(job_id)
        assert held and running is not None and running.stop_reason is None
        person.abort_button(page).click()  # again
        until(lambda: running.stop_reason is not None, "the abort")
        expect(dock).not_to_be_attached()

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
        hello = {"gateway": "local", "version": "0.1.0", "now_s": 1769860830.5, "loops": [], "back_s": 10.0}
        text = stream(hello=hello, jobs={"jobs": [LIVE_JOB]})
        page = pages.open("/ui/jobs")
        page.route("**/live*", lambda route: route.fulfill(body=text, content_type="text/event-stream"))
        page.reload()
        dock = person.dock(page)
        expect(dock).to_contain_text("asked to stop, gateway gw-2 has not confirmed it")
        expect(dock).not_to_contain_text("restored")

    def test_one_whose_answer_was_lost_is_confirmed_by_the_stream(self, site: SimulatedSite, pages: Pages) -> None:
        page = pages.open("/ui/jobs")
        job = LIVE_JOB | {"gateway": "local", "progress": 0.4}
        hello = {"gateway": "local", "version": "0.1.0", "now_s": time.time(), "loops": [], "back_s": 10.0}
        text = stream(hello=hello, jobs={"jobs": [job | {"stopping": False}]})
        page.route("**/live*", lambda route: route.fulfill(body=text, content_type="text/event-stream"))
        page.reload()
        page.evaluate(
            """(id) => import("/ui/js/aborting.js").then(({ abortError }) => {
              abortError.value = new Map([[id, "Abort not confirmed: The service has not answered within 10 s."]]);
            })""",
            job["id"],
        )
        dock = person.dock(page)
        expect(dock.get_by_role("alert")).to_be_visible()
        text = stream(hello=hello, jobs={"jobs": [job]})
        expect(dock).to_contain_text("stopping, the loop is being restored")
        expect(dock.get_by_role("alert")).not_to_be_attached()

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
            expect(person.dock(page)).not_to_be_attached()
        assert shown == [None, "of the new session"]
        assert site.service.store.get(job_id).reason is Reason.OPERATOR


class TestManyLoops:
    def test_what_is_begun_is_what_was_announced(self, site: SimulatedSite, pages: Pages) -> None:
        """Who types on and presses the button before the next announcement has come begins nothing."""
        page = pages.open("/ui/batches")
        person.sign(page)
        loops = page.get_by_label("Loops", exact=True)
        loops.fill("TIC-*")
        expect(page.get_by_role("button", name="Retune 1 loop")).to_be_enabled()
        page.route("**/batches/preview", lambda route: None)
        loops.fill("*")
        expect(page.get_by_role("button", name="Retune 1 loop")).to_be_disabled()

    def test_a_field_that_is_no_number_is_not_left_out(self, site: SimulatedSite, pages: Pages) -> None:
        page = pages.open("/ui/batches")
        person.sign(page)
        page.get_by_label("Loops", exact=True).fill("*")
        expect(page.get_by_role("button", name="Retune 2 loops")).to_be_enabled()
        page.get_by_label("At once per bus").fill("1.5")
        expect(page.get_by_role("button", name="Retune", exact=True)).to_be_disabled()
        expect(page.get_by_role("region", name="Retune many loops")).to_contain_text("A field is not a whole number.")


class TestStream:
    def test_a_service_that_comes_back_with_other_limits(self, tmp_path: Path, browser: Browser) -> None:
        service = Service(tmp_path)
        with served(app_of(service.jobs)) as server:
            pages = Pages(browser, f"http://127.0.0.1:{server.port}")
            page = pages.open(LOOP)
            settings = page.get_by_role("region", name="Gains and limits")
            expect(settings).to_contain_text("0.0 … 100.0")
        service.jobs.stop()
        entries = [loop_entry(pv_limits={"low": 10.0, "high": 77.0}), loop_entry(tag=OTHER, channel=2)]
        service.loops = parse_site({"loops": entries}, "test").loops
        jobs = service.more_jobs(lambda config: FakeLoop(service.controller))
        with served(app_of(jobs), port=server.port):
            expect(settings).to_contain_text("10.00 … 77.00")
            pages.close()
        jobs.stop()
        service.store.close()

    def test_a_service_that_comes_back_without_the_loop(self, tmp_path: Path, browser: Browser) -> None:
        service = Service(tmp_path)
        with served(app_of(service.jobs)) as server:
            pages = Pages(browser, f"http://127.0.0.1:{server.port}")
            page = pages.open(f"/ui/loops/{OTHER}")
            expect(page.get_by_role("heading", name=OTHER)).to_be_visible()
        service.jobs.stop()
        service.loops = parse_site({"loops": [loop_entry()]}, "test").loops
        jobs = service.more_jobs(lambda config: FakeLoop(service.controller))
        with served(app_of(jobs), port=server.port):
            expect(page.get_by_role("main")).to_contain_text(f"There is no loop {OTHER} here.")
            expect(page.locator(".banner[role=alert]")).not_to_be_attached()
            pages.close()
        jobs.stop()
        service.store.close()

    def test_a_connection_that_is_dead_is_made_anew(self, site: SimulatedSite, pages: Pages) -> None:
        """A stream that never says anything again, and never ends, as of a gateway that has lost its power."""
        page = pages.open("/ui/")
        held: list[Route] = []
        page.route("**/live*", lambda route: held.append(route) if not held else route.continue_())
        page.reload()
        banner = ".banner[role=alert]"
        person.remember(page, banner)
        until(lambda: len(person.remembered(page)) > 0, "the banner")
        assert held and "Service offline" in person.remembered(page)[0]
        expect(page.locator(banner)).not_to_be_attached()

    def test_what_was_heard_before_a_page_was_hidden_is_not_shown_as_present(
        self, site: SimulatedSite, pages: Pages
    ) -> None:
        context = pages.context()
        context.clock.install()
        values = {
            "tag": TAG, "pv": 50.0, "sp": 50.0, "mv": 40.0, "mode": "automatic", "age_s": 0.1, "under_test": False,
            "on_trial": False, "no_data": None, "last": None, "gateway": "local", "job": None, "last_job": None,
        }  # fmt: skip
        now_s = time.time()
        hello = {"gateway": "local", "version": "0.1.0", "now_s": now_s, "loops": [TAG], "back_s": 10.0}
        text = stream(hello=hello, loops={"now_s": now_s, "loops": [values]})
        context.route("**/live*", lambda route: route.fulfill(body=text, content_type="text/event-stream"))
        page = pages.another(context, LOOP)
        pv = person.face(page).locator(".big")
        expect(pv).to_have_text("50.0")
        page.evaluate(HIDE, True)
        page.clock.fast_forward("01:05")
        context.unroute("**/live*")
        context.route("**/live*", lambda route: None)
        page.evaluate(HIDE, False)
        page.clock.run_for(600)  # less than what is a silence
        assert pv.text_content() == person.DASH

    def test_a_further_window_loads_beside_many_that_nobody_sees(self, site: SimulatedSite, pages: Pages) -> None:
        """A browser makes six connections to a service, and the stream of each window takes one."""
        context = pages.context()
        context.clock.install()
        context.clock.pause_at(time.time() + 1.0)  # no window has been hidden for a minute
        site.service.under_test()
        windows: list[Page] = []
        for _ in range(9):
            for page in windows[-1:]:
                page.evaluate(HIDE, True)
            windows.append(pages.another(context, LOOP))
            expect(person.abort_button(windows[-1])).to_be_enabled()  # the stream says that a test runs
        with windows[0].expect_request("**/live*"):
            windows[0].evaluate(HIDE, False)
        expect(person.abort_button(windows[0])).to_be_enabled()

    def test_the_count_of_what_is_abnormal_goes_on_in_a_tab_that_nobody_sees(
        self, site: SimulatedSite, pages: Pages
    ) -> None:
        context = pages.context()
        context.clock.install()
        page = pages.another(context, "/ui/alarms")
        expect(page.get_by_text("No active alarms.")).to_be_visible()
        page.evaluate(HIDE, True)
        page.clock.fast_forward("01:05")
        service = site.service
        service.tune.ends = Failed(Reason.RESTORE_UNCONFIRMED, "the loop could not be read back")
        service.wait(service.jobs.start(TAG, FastRetune()).id)
        expect(page.get_by_role("main")).to_contain_text("Not confirmed that the loop is as before the test")
        expect(page).to_have_title("(1) Loopwright")


def test_a_job_whose_loop_is_not_configured_any_more(site: SimulatedSite, pages: Pages) -> None:
    job_id = proposal(site.service, OTHER)
    del site.service.loops[OTHER]
    with site.service.store.writing() as session:
        session.execute(delete(LoopRow).where(LoopRow.tag == OTHER))
    page = pages.open(f"/ui/jobs/{job_id}")
    expect(page.get_by_role("main")).to_contain_text(f"The loop {OTHER} is not configured any more")
    expect(person.headline(page)).to_have_text("New gains are proposed")
    expect(page.get_by_role("link", name="Report")).to_be_visible()


def test_an_address_that_was_typed_in_wrongly(site: SimulatedSite, pages: Pages) -> None:
    page = pages.open("/ui/")
    with pages.expecting("status of 404"):
        page.goto("/ui/loops/100%")
        expect(page.get_by_role("main")).to_contain_text("There is no loop 100% here.")


def test_a_trend_goes_on_when_the_clock_of_the_service_is_put_back(site: SimulatedSite, page: Page) -> None:
    found = page.evaluate(
        """async () => {
          const { Ring } = await import("/ui/js/ring.js");
          const ring = new Ring();
          const take = (at, pv) =>
            ring.take({ past: false, at_s: [at, at + 0.1], pv: [pv, pv], sp: [1, 1], mv: [1, 1], gap_before: [] });
          for (const at of [1000, 1000.2, 5000, 5000.2]) take(at, 1);
          for (const at of [1400, 1400.2]) take(at, 2);
          return [...ring.since(0).pv].map((each) => (Number.isNaN(each) ? null : each));
        }"""
    )
    assert found == [1, 1, 1, 1, None, 2, 2, 2, 2]


def test_no_line_is_drawn_across_missing_samples_of_a_record(site: SimulatedSite, page: Page) -> None:
    record = {
        "at_s": [0.0, 1.0, 9.0], "until_s": [0.0, 1.0, 9.0], "pv_min": [1.0, 2.0, 3.0], "pv_max": [1.0, 2.0, 3.0],
        "mv_min": [4.0, 5.0, 6.0], "mv_max": [4.0, 5.0, 6.0], "sp": [1.0, 1.0, 1.0], "gap_before": [False, False, True],
        "marks": [], "noise": None,
        "explained": {"model": [1.0, 2.0, 3.0], "residual_min": [0.0] * 3, "residual_max": [0.0] * 3},
    }  # fmt: skip
    found = page.evaluate(
        """async (record) => {
          const { columns } = await import("/ui/js/views/record.js");
          const found = columns(record);
          const shown = (values) => values.map((each) => (Number.isNaN(each) ? null : each));
          return [found.t, ...["pv", "mv", "model"].map((name) => shown(found[name]))];
        }""",
        record,
    )
    assert found == [
        [0, 1, 5, 9],
        [1, 2, None, 3],
        [4, 5, None, 6],
        [1, 2, None, 3],
    ]


def test_the_longest_window_of_a_fast_loop_has_its_beginning(site: SimulatedSite, page: Page) -> None:
    """Half an hour and more at 100 samples a second: thinned, with its peaks and with its gap."""
    found = page.evaluate(
        """async () => {
          const { Ring } = await import("/ui/js/ring.js");
          const ring = new Ring();
          const peak = 20 * 6000; // 20 min after the beginning
          for (let n = 0; n < 200_000; n++) {
            if (n === 150_000) ring.gap();
            ring.push(1e9 + n / 100, n === peak ? 9 : Math.sin(n / 500), 0, 40);
          }
          const { at, pv } = ring.since(ring.last - 1800);
          let longest = 0;
          for (let n = 1; n < at.length; n++) longest = Math.max(longest, at[n] - at[n - 1]);
          return [ring.last - at[0], at.length <= ring.room, Math.max(...pv.filter((each) => each === each)), longest,
                  pv.filter((each) => each !== each).length, at.every((each, n) => !n || each > at[n - 1])];
        }"""
    )
    back_s, fits, largest, longest_s, gaps, in_order = found
    assert back_s >= 1800.0 and fits and largest == 9.0 and gaps == 1 and in_order
    assert longest_s < 5.0, "less than three pixels of the window"
