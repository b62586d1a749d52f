"""What is abnormal, on every view, of a loop whose plant is switched off in the middle of a test; acknowledged."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.browser.pages import Pages
from tests.browser.site import TAG, Site
from tests.unit.service.processes import until


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    """Processes of its own: the plant ends. The loop is the only one."""
    with ExitStack() as stack:
        site = Site(stack, tmp_path, more_loops=())
        site.at_rest(10.0)
        yield site


def test_a_plant_that_is_switched_off_in_a_test(site: Site, pages: Pages) -> None:
    abnormal, loops = pages.open("/ui/alarms"), pages.open()
    expect(loops.get_by_role("row", name=TAG).locator(".pvnum")).to_have_text(re.compile(r"^50\."))
    expect(abnormal.get_by_text("No active alarms.")).to_be_visible()
    expect(abnormal).to_have_title("Loopwright")
    job = site.http.post(f"/loops/{TAG}/retune", json={"by": "A. Lind"}).json()["url"]
    until(lambda: site.http.get(job).json()["stage"] == "relay")
    site.plant.stop()

    lost = abnormal.get_by_role("row", name=re.compile(r"Node 10h \(16\) is lost: its heartbeat has stopped"))
    expect(lost.get_by_role("link", name=TAG)).to_be_visible()
    failed = abnormal.get_by_role("row", name=re.compile("The last test failed"))
    expect(failed.get_by_role("link", name="the job")).to_have_attribute("href", f"/ui{job}")
    expect(abnormal).to_have_title("(2) Loopwright")
    expect(abnormal.get_by_role("link", name="2 active alarm")).to_be_visible()
    expect(lost.get_by_role("button")).to_have_count(0)
    expect(loops.get_by_role("row", name=TAG)).to_contain_text("Node 10h (16) is lost")

    failed.get_by_role("button", name="Acknowledge").click()
    field = abnormal.get_by_label("Your name")
    expect(field).to_be_focused()
    expect(abnormal.get_by_role("button", name="Acknowledge", exact=True)).to_be_disabled()
    field.fill("B. Berg")
    field.press("Enter")
    expect(abnormal).to_have_title("(1) Loopwright")
    expect(failed).to_have_count(0)
    (entry,) = site.http.get("/audit?what=acknowledge_alarm").json()
    assert (entry["by"], entry["loop"]) == ("B. Berg", TAG)

    with pages.expecting("ERR_CONNECTION_REFUSED"):
        assert site.service.stop() == 0
        silent = abnormal.get_by_role("row", name=re.compile("Service offline"))
        expect(silent).to_be_visible()
        expect(abnormal.get_by_role("row", name=re.compile(r"Node 10h \(16\) is lost"))).to_have_class("old")
        expect(abnormal).to_have_title("(2) Loopwright")
        expect(abnormal.locator("body")).to_contain_text("What is shown is old")
