"""The record of pulses of the manual output with its model, as a picture.

    python -m benchmarks.manual_picture docs/manual.png

A loop in manual is rehearsed on a plant of one lag with dead time, under present gains that are too high.
"""

from __future__ import annotations

from pathlib import Path

from benchmarks.command import parser_of
from benchmarks.refusals import Case, draw, rehearsed
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.gains import Gains

LOOP = Case("TIC-101, in manual", excitation=Excitation.MANUAL, gains=Gains(6.0, 4.0), noise=0.03)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("picture", type=Path, help="where the picture goes")
    path = parser.parse_args().picture
    job, samples = rehearsed(LOOP)
    draw(path, job, samples)
    print(f"{job.state}: {job.new_gains} ({path.stat().st_size // 1000} kB)")


if __name__ == "__main__":
    main()
