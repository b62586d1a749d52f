"""Makes the pictures of docs/page.md from a live service: python -m tests.browser.pictures [FOLDER] [NAME ...]

It takes some three minutes, ten on a busy machine: the plants run in real time.
"""

from __future__ import annotations

import argparse
import io
import os
import re
import shutil
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

from PIL import Image
from playwright.sync_api import Browser, Page, expect, sync_playwright

from tests.browser import CHROMIUM, person
from tests.browser.conftest import OPTIONS
from tests.browser.fleet import Fleet, Member, locked_service
from tests.browser.pages import PATIENCE_MS
from tests.browser.trend import columns
from tests.unit.service.processes import until

FOLDER = Path(__file__).parents[2] / "docs" / "page"
LAPTOP = {"width": 1440, "height": 900}
HIGHER = {"width": 1440, "height": 1000}
LOW = {"width": 1440, "height": 480}
SMALL = {"width": 720, "height": 440}
WITH_FORM = {"width": 1440, "height": 1180}
TALL = {"width": 1440, "height": 1500}
PHONE = {"width": 390, "height": 844}
PATIENCE_S = 600.0
"""A busy machine computes slowly, and the plants do not wait for it."""
WAVE_S = 24.0
"""Plant time of the relay that is shown, more than an ultimate period of the loop."""
MANY_COLUMNS = 200
"""Of pixels in which PV is drawn: the past of the trend has come."""
COLOURS, VIVID = 256, 48
"""Of a picture: the most frequent ones, which are those of the page, and of what is vivid, which is rare, as many."""
OUTSIDE = MappingProxyType({"pv_limits": {"low": 50.2, "high": 52.0}})
RESULT, WAITS, REFUSED, ACCEPTED = "TIC-101", "TIC-310", "FIC-220", ("PIC-110", "FIC-120")
CHANGED = ACCEPTED[0]
"""Its gains are changed by hand at the controller."""
UNTUNED = "LIC-130"
UNDER_TEST = "TIC-102", "TIC-201"
FLEET = (
    Member(RESULT, "Distillation", "Reboiler outlet temperature", "degC"),
    Member("TIC-102", "Distillation", "Column top temperature", "degC", "model-41", 20.0, 12.0, 50.3),
    Member("PIC-110", "Distillation", "Column head pressure", "mbar", "model-12", 60.0, 2.5, 50.4),
    Member("FIC-120", "Distillation", "Reflux flow", "m3/h", "model-14", 70.0, 1.5, 49.6),
    Member(UNTUNED, "Distillation", "Sump level", "%", "sopdt", 100.0, 12.0, 50.0, 0.004),
    Member("TIC-201", "Reactor", "Jacket temperature", "degC", "model-20", 12.0, 10.0, 50.2),
    Member("QIC-210", "Reactor", "Conductivity after neutralising", "mS/cm", "model-30", 30.0, 6.0, 49.8),
    Member(REFUSED, "Reactor", "Feed A", "m3/h", "model-14", 30.0, 2.0, 50.2, 0.03),
    Member("PIC-301", "Utilities", "Steam header pressure", "bar", "model-14", 50.0, 2.0, mode="manual"),
    Member(WAITS, "Utilities", "Hot water supply", "degC", "model-14", 90.0, 1.6, 50.5),
    Member("FIC-320", "Utilities", "Cooling water to reactor", "m3/h", "model-14", 50.0, 2.0, 49.9, changes=OUTSIDE),
    Member("TIC-401", "Tank farm", "Heating of tank 4", "degC", on_dead_bus=True),
)


class Photographer:
    """Takes the pictures. url: of the service.  only: names of the pictures; empty: all."""

    def __init__(self, browser: Browser, url: str, folder: Path, only: list[str]) -> None:
        self._browser, self.url, self._folder, self._only = browser, url, folder, only

    def take(
        self, name: str, path: str, until: Callable[[Page], Any], size: dict[str, int] = LAPTOP, palette: str = "light"
    ) -> None:
        """One picture, once the page is as `until` wants it."""
        if self._only and name not in self._only:
            return
        context = self._browser.new_context(
            base_url=self.url, viewport=size, color_scheme=palette, reduced_motion="reduce"
        )
        context.set_default_timeout(PATIENCE_MS)
        context.add_init_script("localStorage.setItem('loopwright.signature', 'M. Weber')")
        page = context.new_page()
        page.goto(path)
        until(page)
        page.evaluate("document.fonts.ready")
        self._keep(name, page.screenshot(animations="disabled", caret="hide"))
        context.close()

    def _keep(self, name: str, picture: bytes) -> None:
        file = self._folder / f"{name}.png"
        whole = Image.open(io.BytesIO(picture)).convert("RGB")
        counted = cast(list[tuple[int, tuple[int, ...]]], whole.getcolors(whole.width * whole.height))
        frequent = sorted(counted, reverse=True)
        vivid = [each for each in frequent if max(each[1]) - min(each[1]) > 100][:VIVID]
        found = vivid + [each for each in frequent if each not in vivid][: COLOURS - len(vivid)]
        palette = Image.new("P", (1, 1))
        palette.putpalette([part for _, colour in found for part in colour])
        whole.quantize(palette=palette, dither=Image.Dither.NONE).save(file, optimize=True)
        print(f"{name}.png  {os.path.getsize(file) / 1000:.0f} kB")


def prepare(fleet: Fleet) -> dict[str, str]:
    """Brings the loops to what the pictures show, but for the tests under way. Returns the URLs of jobs by loop."""
    fleet.pace(3.0)
    jobs = {tag: fleet.retune(tag, by="M. Weber") for tag in (*ACCEPTED, "QIC-210", WAITS)}
    for tag in ACCEPTED:
        assert fleet.finished(jobs[tag], PATIENCE_S)["state"] == "proposed"
        assert fleet.http.post(f"{jobs[tag]}/accept", json={"by": "A. Lind"}).status_code == 200
    for tag in ("QIC-210", WAITS):
        fleet.finished(jobs[tag], PATIENCE_S)
    fleet.http.post(f"{jobs['QIC-210']}/rollback", json={"by": "A. Lind"})
    fleet.change_gains(CHANGED, 55.0, 3.0)
    fleet.pace(1.0)
    jobs |= {tag: fleet.retune(tag, by="M. Weber") for tag in (REFUSED, RESULT)}
    for tag in (REFUSED, RESULT):
        fleet.finished(jobs[tag], PATIENCE_S)
    for tag in jobs:
        fleet.http.get(f"{jobs[tag]}/designs", timeout=600.0)  # returns once the figures of the job are stored
    return jobs


def photograph(fleet: Fleet, camera: Photographer, jobs: dict[str, str], locked: str) -> None:
    """All pictures. The last ones are of tests under way."""
    drawn = "What the model leaves"

    def result(page: Page) -> None:
        expect(person.present(page).locator(".big")).to_have_text(re.compile(r"\d"))
        expect(page.get_by_role("img", name=drawn)).to_be_visible()
        expect(page.get_by_role("slider", name="Ms")).to_be_enabled()

    def refused(page: Page) -> None:
        expect(person.headline(page)).to_contain_text("Refused: ")
        expect(page.get_by_role("img", name="MV", exact=True)).to_be_visible()

    def alarm(page: Page) -> None:
        expect(page.get_by_role("row").nth(3)).to_be_visible()

    def asked(page: Page) -> None:
        form = person.form(page)
        expect(form).not_to_contain_text("Asking what would happen")
        page.get_by_role("button", name="More options").click()

    def many(page: Page) -> None:
        page.get_by_role("textbox", name="Loops").fill("*IC-1*")
        expect(page.get_by_role("button", name=re.compile(r"Retune \d loops"))).to_be_visible()

    def signed_out(page: Page) -> None:
        expect(page.get_by_label("API key")).to_be_focused()

    for name, size, palette in (
        ("loop", TALL, "light"),
        ("loop-dark", TALL, "dark"),
        ("loop-phone", PHONE, "light"),
    ):
        camera.take(name, f"/ui/loops/{RESULT}", result, size, palette)
    camera.take("refused", f"/ui{jobs[REFUSED]}", refused)
    camera.take("jobs", "/ui/jobs", lambda page: expect(page.get_by_role("row")).to_have_count(len(jobs) + 1), LOW)
    camera.take("alarms", "/ui/alarms", alarm, LOW)
    camera.take("retune", f"/ui/loops/{UNTUNED}", asked, WITH_FORM)
    camera.take("batches", "/ui/batches", many, LOW)
    camera.take("log", "/ui/log", lambda page: expect(page.get_by_role("row").nth(len(jobs))).to_be_visible(), LOW)
    camera.url, url = locked, camera.url
    camera.take("sign-in", "/ui/", signed_out, SMALL)
    camera.url = url

    under_test = {tag: fleet.retune(tag, by="A. Lind") for tag in UNDER_TEST}
    first = under_test[UNDER_TEST[0]]
    began = fleet.until(first, lambda job: job["stage"] == "relay")["plant_time_s"]
    # Some switches: the wave can be seen.
    fleet.until(first, lambda job: job["plant_time_s"] > began + WAVE_S or job["stage"] != "relay")

    def testing(page: Page) -> None:
        expect(person.under_test(page).locator(person.STEP)).to_be_visible()
        expect(person.face(page, UNDER_TEST[0]).locator(".big")).not_to_have_text(person.DASH)
        until(lambda: len(columns(page, UNDER_TEST[0])[0]) > MANY_COLUMNS)

    def overview(page: Page) -> None:
        expect(page.locator(".spark path").first).to_be_attached()
        expect(page.get_by_role("link", name="active alarm")).to_be_visible()
        expect(page.get_by_role("row", name="TIC-401")).to_contain_text("Bus")

    camera.take("test", f"/ui/loops/{UNDER_TEST[0]}", testing)
    for name, size, palette in (
        ("loops", HIGHER, "light"),
        ("loops-dark", HIGHER, "dark"),
        ("loops-phone", PHONE, "light"),
    ):
        camera.take(name, "/ui/", overview, size, palette)
    for url in under_test.values():
        fleet.http.post(f"{url}/abort")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.browser.pictures", description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER, help="default: docs/page")
    parser.add_argument("names", nargs="*", help="of pictures; default: all")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright, ExitStack() as stack:
        work = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        browser = playwright.chromium.launch(executable_path=shutil.which(CHROMIUM), args=OPTIONS)
        stack.callback(browser.close)
        locked = locked_service(stack, work)
        fleet = Fleet(stack, work, FLEET, ts=0.1)
        photograph(fleet, Photographer(browser, fleet.url, options.folder, options.names), prepare(fleet), locked)


if __name__ == "__main__":
    main()
