"""The images: built without cache, their size and what is in it."""

import time
from pathlib import Path

from compose_test.shell import check, output, tell
from compose_test.stack import IMAGE, compose, in_image

MAX_BYTES = 600e6


def build() -> None:
    started = time.monotonic()
    compose("build", "--no-cache", "bus")
    seconds = time.monotonic() - started
    size = _size(IMAGE)
    tell(f"image       built in {seconds:.0f} s without cache, {size / 1e6:.0f} MB")
    check("image under 600 MB", size < MAX_BYTES)
    folders = "du -sm /opt/loopwright/lib/python3*/site-packages/* | sort -rn | head -7; du -sm /usr /opt/loopwright"
    lines = in_image("sh", "-c", folders, options=("--user", "0:0")).splitlines()
    tell("            " + ", ".join(f"{Path(line.split()[1]).name} {line.split()[0]} MB" for line in lines))
    rest = "ls -d /source /opt/loopwright/bin/pip* /opt/loopwright/lib/*/*/pip ~root/.cache 2>/dev/null; true"
    left = in_image("sh", "-c", rest, options=("--user", "0:0"))
    check("nothing of the build left inside", not left.strip(), left)


def build_database() -> None:
    started = time.monotonic()
    compose("build", "--no-cache", "database")
    seconds, size = time.monotonic() - started, _size(f"{IMAGE}-postgres")
    tell(f"database    image built in {seconds:.0f} s without cache, {size / 1e6:.0f} MB")


def _size(image: str) -> int:
    return int(output("docker", "image", "inspect", "--format", "{{.Size}}", image))
