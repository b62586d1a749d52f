"""Samples or bins of which length are looked at, and how far back they reach. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopwright.service.listening.bins import Bins
from loopwright.service.listening.rings import LEVELS, SAMPLES

COARSEST, FINEST = 1.0 / 40.0, 1.0 / 160.0
"""Longest time that becomes one sample of a stretch, and time below which a shorter one tells nothing more, in T95. The
ultimate period of eight in ten plants is 0.07 to 0.95 T95: twelve samples in it from 0.3 T95 on, three at least."""
ENOUGH = 50.0
"""T95 of history with which the finest bins are taken: room for twelve set-point changes."""
MIN_OF_BIN = 4
"""Samples in a bin below which the samples themselves reach as far back."""
_EDGE = 0.05
"""Part of a ring, at its end, that may be overwritten before it is read."""
FIRST_S = (1.0 - _EDGE) * LEVELS[0][0] * LEVELS[0][1]
"""Wall time that is read first, to learn how the samples come, s."""


@dataclass(frozen=True, slots=True)
class Resolution:
    """What is to be read of a history.

    from_s: from when on, wall time.
    together: the number of samples that become one of a stretch.
    """

    from_s: float
    together: int


def wall_period_s(bins: Bins) -> float | None:
    """The usual wall time from one sample to the next, s; None where no two rows follow each other."""
    following = (bins["gap"][1:] == 0) & (bins["gap"][:-1] == 0)
    each = np.diff(bins["at_s"])[following] / bins["count"][:-1][following]
    return float(np.median(each)) if len(each) else None


def resolution(bins: Bins, samples_in_t95: float) -> Resolution | None:
    """The finest rows that reach back far enough, or else those that reach back the farthest; None where nothing was
    heard.

    bins: the history of FIRST_S.
    samples_in_t95: T95 of the loop in samples.
    """
    period_s = wall_period_s(bins)
    if period_s is None:
        return None
    kept, now_s = round((1.0 - _EDGE) * SAMPLES), float(bins["until_s"][-1])
    later = np.cumsum(bins["count"][::-1].astype(np.int64))[::-1]  # samples from each row on
    # by the samples heard and not by their period, which is no constant on a simulated plant; before the bins by it
    from_s = float(bins["at_s"][min(int(np.argmax(later <= kept)), len(bins) - 1)])
    found = [(1, kept, from_s - period_s * max(0, kept - int(later[0])))]
    for width_s, size in LEVELS:
        count, rows = round(width_s / period_s), round((1.0 - _EDGE) * size)
        if MIN_OF_BIN <= count <= COARSEST * samples_in_t95:
            found.append((count, rows, now_s - rows * width_s))
    reaching = [each for each in found if each[0] * each[1] >= ENOUGH * samples_in_t95]
    count, _, from_s = reaching[0] if reaching else max(found, key=lambda each: each[0] * each[1])
    return Resolution(from_s, max(count, int(FINEST * samples_in_t95)))
