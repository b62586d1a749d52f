"""Data that are missing: a plant that stops, a bus that goes and comes back, frames that are lost.

What is old is grey and has its age, words say what is wrong, and the trend has a gap: no line is drawn across what is
missing, while it comes and when it is looked at later.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack

import pytest
from playwright.sync_api import Page, expect

from loopwright.protocol.profile import channel_ids
from tests.browser import person, trend
from tests.browser.site import TAG, Site
from tests.e2e.plantsite import STAGES
from tests.faults.faulty_hub import FaultyHub, well
from tests.unit.service import processes

PATIENCE_S = 60.0
WINDOW_S = 30.0
MIN_COLUMNS = 150
"""Of the trend's 1,000: 4.5 s of 30 s, 37 columns of the trend of 2 min."""
LOOK_MS = 100.0
AGE = re.compile(r"^\d.* old$")
SHORT_S = 1.5
"""Shorter than the silence after which values count as old."""
SLOW = 0.2
"""The pace at which a single sample can be seen: four a second."""


@pytest.fixture
def bus() -> str | None:
    """Of a hub that the test runs itself; None: the hub is a process of its own."""
    return None


@pytest.fixture
def site(bus: str | None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """Processes of the test's own, which it ends, and a loop at rest."""
    with ExitStack() as stack:
        site = Site(stack, tmp_path_factory.mktemp("site"), more_loops=(), bus=bus)
        site.at_rest(1.0)
        yield site


def until(page: Page, seen: Callable[[], bool]) -> None:
    give_up = time.monotonic() + PATIENCE_S
    while not seen():
        assert time.monotonic() < give_up, trend.columns(page)
        page.wait_for_timeout(LOOK_MS)  # each look reads the whole canvas


def empty_at_the_right(page: Page) -> float:
    """The share of the window, 30 s, after the latest PV."""
    found, width = trend.columns(page)
    return (width - found[-1]) / width if found else 1.0


def watched(page: Page) -> None:
    """The loop's page with its trend of 30 s, up to the present, with enough before it to be seen in that of 2 min."""
    person.open_loop(page)
    page.get_by_role("button", name="30 s").click()
    until(page, lambda: len(trend.columns(page)[0]) > MIN_COLUMNS and empty_at_the_right(page) < 0.02)


def one_gap(page: Page, window_s: float = WINDOW_S) -> float:
    """The width of the only gap, s, once the trend goes on behind it."""
    until(page, lambda: empty_at_the_right(page) < 0.02 and len(trend.gaps(page, window_s)) == 1)
    [gap] = trend.gaps(page, window_s)
    return gap.seconds


def seen_later(page: Page, window: str = "30 s", window_s: float = WINDOW_S) -> None:
    """The history has the gap, too."""
    page.reload()
    page.get_by_role("button", name=window).click()
    until(page, lambda: len(trend.gaps(page, window_s)) == 1)
    assert TAG in page.title()


def is_old(page: Page, pv: str | re.Pattern[str] = "50.000") -> None:
    """The values of the loop's page are those of before."""
    face = person.face(page)
    expect(face.locator(".age")).to_have_text(AGE)
    expect(face).to_have_class(re.compile(r"\bold\b"))
    expect(face.locator(".big")).to_have_text(pv)


def test_the_plant_is_started_anew(site: Site, page: Page) -> None:
    watched(page)
    site.plant.kill()
    killed = time.monotonic()
    until(page, lambda: empty_at_the_right(page) > 0.12)  # time goes on, and the trend with it
    is_old(page)
    # a machine that stood still before has left a gap that is one
    assert [each for each in trend.gaps(page, WINDOW_S) if each.ago_s < time.monotonic() - killed] == []
    site.start_plant()
    site.plant.wait_ready()
    expect(person.present(page).locator(".big")).not_to_have_text(person.DASH)
    assert one_gap(page) > 3.0
    seen_later(page)


def test_the_plant_stops_and_then_the_bus_goes_and_comes_back(site: Site, page: Page) -> None:
    row = page.get_by_role("row", name=TAG)
    expect(row.locator(".pvnum")).to_have_text("50.000")
    expect(page.get_by_text("No active alarms")).to_be_visible()
    site.plant.kill()
    expect(row.locator(".age")).to_have_text(AGE)
    expect(row.locator(".pvnum")).to_have_text("50.000")
    expect(row).to_contain_text("Node 10h (16) is lost")
    expect(page.get_by_role("link", name="1 active alarm")).to_be_visible()
    site.hub.kill()
    expect(row).to_contain_text(f"Bus {site.bus} is down")
    expect(page.get_by_text(f"Bus {site.bus} is down, opening it again every 2 s.")).to_be_visible()
    page.get_by_role("main").get_by_role("link", name=TAG).click()
    is_old(page)
    expect(page.get_by_role("main")).to_contain_text(f"Bus {site.bus} is down")
    expect(page.get_by_role("region", name="Gains and limits")).not_to_contain_text("80.00")
    start = page.get_by_role("button", name=f"Retune {TAG}")
    person.sign(page)
    expect(start).to_be_disabled()
    site.start_hub()
    site.at_rest(1.0)
    expect(person.present(page).locator(".big")).to_have_text("50.000")
    expect(page.get_by_role("main")).not_to_contain_text("is down")
    page.keyboard.press("Escape")
    page.get_by_role("button", name="2 min").click()
    until(page, lambda: len(trend.gaps(page, 120.0)) == 1)
    [gap] = trend.gaps(page, 120.0)
    assert gap.seconds > 3.0
    expect(start).to_be_enabled()


def test_the_bus_goes_and_comes_back_while_its_trend_is_watched(site: Site, page: Page) -> None:
    main, down = page.get_by_role("main"), f"Bus {site.bus} is down"
    watched(page)
    site.hub.kill()
    expect(main).to_contain_text(down)
    is_old(page)
    until(page, lambda: empty_at_the_right(page) > 0.12)
    assert trend.gaps(page, WINDOW_S) == []  # nor is anything drawn of the time since
    age_s = person.number(person.face(page).locator(".age").text_content())
    site.start_hub()
    expect(person.present(page).locator(".big")).to_have_text("50.000")
    expect(main).not_to_contain_text(down)
    expect(page.get_by_text("No active alarms")).to_be_visible()
    page.get_by_role("button", name="2 min").click()
    assert one_gap(page, 120.0) > max(3.0, age_s)
    seen_later(page, "2 min", 120.0)


def test_the_bus_goes_in_a_test_and_comes_back(site: Site, page: Page) -> None:
    site.write("plant_pace", 2.0)
    person.open_loop(page)
    job = site.in_stage(STAGES["fast-relay"])
    person.in_stage(page, "Relay test")
    site.hub.kill()
    expect(page.get_by_role("main")).to_contain_text(f"Bus {site.bus} is down")
    is_old(page, re.compile(r"\d"))
    expect(person.headline(page)).to_contain_text("Failed:")
    assert site.job(job)["state"] == "failed"
    site.start_hub()
    site.at_rest(1.0)
    expect(person.present(page).locator(".big")).to_have_text("50.000")
    page.get_by_role("button", name="2 min").click()
    assert one_gap(page, 120.0) > 3.0


class TestFramesLost:
    @pytest.fixture
    def hub(self) -> Iterator[FaultyHub]:
        hub = FaultyHub()
        serving = threading.Thread(target=hub.serve, daemon=True)
        serving.start()
        yield hub
        hub.stop()
        serving.join()

    @pytest.fixture
    def bus(self, hub: FaultyHub) -> str | None:
        return hub.url

    def test_samples_that_are_lost_are_a_gap_and_nothing_is_abnormal(
        self, hub: FaultyHub, site: Site, page: Page
    ) -> None:
        watched(page)
        pv, mv = channel_ids(1)[:2]
        hub.fault = lambda can_id: () if can_id in (pv, mv) else (0.0,)
        began_s, first = time.monotonic(), hub.sample_number
        processes.until(lambda: hub.sample_number - first > SHORT_S / site.case.ts)
        lost_s = time.monotonic() - began_s  # a busy machine brings samples late, and several at once
        hub.fault = well
        assert lost_s - 0.3 < one_gap(page) < lost_s + 1.0
        expect(page.get_by_text("No active alarms")).to_be_visible()
        expect(person.present(page).locator(".big")).to_have_text("50.000")
        seen_later(page)

    def test_one_frame_that_is_lost_in_a_test_is_a_gap_and_the_test_goes_on(
        self, hub: FaultyHub, site: Site, page: Page
    ) -> None:
        site.write("plant_pace", SLOW)
        person.open_loop(page)
        job = site.in_stage(STAGES["fast-relay"])
        person.in_stage(page, "Relay test")
        page.get_by_role("button", name="30 s").click()
        until(page, lambda: len(trend.columns(page)[0]) > 0 and empty_at_the_right(page) < 0.1)
        assert trend.gaps(page, WINDOW_S) == []
        pv, lost = channel_ids(1)[0], list[int]()

        def once(can_id: int) -> Sequence[float]:
            if can_id != pv or lost:
                return (0.0,)
            lost.append(can_id)
            return ()

        hub.fault = once
        assert one_gap(page) > 1.2 * site.case.ts / SLOW  # from the sample before to the one behind: two sample times
        expect(person.under_test(page)).to_be_visible()
        expect(page.get_by_text("No active alarms")).to_be_visible()
        assert site.job(job)["state"] == "running"
        site.http.post(f"{job}/abort")
        site.finished(job)
