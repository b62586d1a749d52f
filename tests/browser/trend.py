"""The trend as it is drawn: a canvas, of which the columns that show PV are looked for."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from playwright.sync_api import Page

from tests.browser.site import TAG

MIN_GAP_PX = 4

# PV is the darkest line, in the light palette: names and grids are paler. The plotting area is that of the overlay.
COLUMNS = """(plot) => {
  const canvas = plot.querySelector("canvas"), over = plot.querySelector(".u-over");
  const outer = canvas.getBoundingClientRect(), inner = over.getBoundingClientRect();
  const ratio = canvas.width / outer.width;
  const [x, y] = [(inner.left - outer.left) * ratio, (inner.top - outer.top) * ratio].map(Math.round);
  const [w, h] = [inner.width * ratio, inner.height * ratio].map(Math.floor);
  const copy = Object.assign(document.createElement("canvas"), { width: w, height: h });
  copy.getContext("2d", { willReadFrequently: true }).drawImage(canvas, x, y, w, h, 0, 0, w, h);
  const { data } = copy.getContext("2d", { willReadFrequently: true }).getImageData(0, 0, w, h);
  const found = [];
  for (let column = 0; column < w; column++) {
    for (let row = 0; row < h; row++) {
      const at = 4 * (row * w + column);
      if (data[at + 3] > 200 && Math.max(data[at], data[at + 1], data[at + 2]) < 72) { found.push(column); break; }
    }
  }
  return { found, width: w };
}"""


@dataclass(frozen=True)
class Gap:
    """Columns between which no PV is drawn.

    seconds: how long that is, of the window.  ago_s: how long ago it began, if the window ends now.
    """

    left: int
    right: int
    seconds: float
    ago_s: float


def columns(page: Page, tag: str = TAG) -> tuple[list[int], int]:
    """The columns in which PV is drawn, from the left, and how many there are."""
    drawn = page.get_by_role("img", name=f"PV and set-point of {tag}").evaluate(COLUMNS)
    return drawn["found"], drawn["width"]


def gaps(page: Page, window_s: float = 120.0) -> list[Gap]:
    """The gaps in PV, not counting what is empty at the left of the first sample."""
    found, width = columns(page)
    wide = [(a, b) for a, b in pairwise(found) if b - a > MIN_GAP_PX]
    return [Gap(a, b, (b - a) * window_s / width, (width - a) * window_s / width) for a, b in wide]
