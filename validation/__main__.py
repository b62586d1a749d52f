"""`make validate`: recompute the papers, write docs/validation.md and its plots, fail if a number left its tolerance.

python -m validation
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

from validation.figures import draw
from validation.references import ROOT, load
from validation.report import document
from validation.run import validate

DOCUMENT = ROOT / "docs/validation.md"
PLOTS = ROOT / "docs/validation"


def main(argv: Sequence[str] | None = None) -> int:
    argparse.ArgumentParser(prog="python -m validation", description=__doc__.splitlines()[0]).parse_args(argv)
    began = time.monotonic()
    references = load()
    papers = validate(references)
    DOCUMENT.write_text(document(papers), encoding="utf-8")
    draw(references, PLOTS)
    for paper in papers:
        counts = ", ".join(f"{count} {verdict}" for verdict, count in paper.counts().items() if count)
        print(f"{paper.title}: {counts}")
    failures = [line for paper in papers for line in paper.failures()]
    for line in failures:
        print(f"FAILED: {line}", file=sys.stderr)
    print(f"{DOCUMENT.relative_to(ROOT)} written, {time.monotonic() - began:.0f} s")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
