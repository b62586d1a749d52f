"""A file that a command writes is whole, or as it was."""

from __future__ import annotations

import os
import resource
from pathlib import Path

import pytest

from loopwright.service.cli.plots.style import new_figure, write
from loopwright.service.cli.whole_file import written_whole


@pytest.fixture
def file(tmp_path: Path) -> Path:
    found = tmp_path / "report.html"
    found.write_text("old")
    return found


def test_it_takes_the_place_of_the_file_that_was_there(file: Path) -> None:
    file.chmod(0o640)
    link = file.with_name("link.html")
    link.symlink_to(file.name)
    with written_whole(link) as new:
        assert new.suffix == ".html" and file.read_text() == "old"
        new.write_text("new")
    assert link.is_symlink() and file.read_text() == "new" and file.stat().st_mode & 0o777 == 0o640
    assert {each.name for each in file.parent.iterdir()} == {"report.html", "link.html"}


def test_a_disk_that_is_full_leaves_the_file_that_was_there(tmp_path: Path) -> None:
    """A limit of the size of files stands for it: a part of the file is written."""
    picture = tmp_path / "job.png"
    picture.write_text("old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            write(new_figure(3.0, 2.0), picture)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert picture.read_text() == "old" and [*tmp_path.iterdir()] == [picture]


def test_what_is_no_file_is_written_as_it_is(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reading = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    with written_whole(pipe) as new:
        new.write_text("for another command")
    assert os.read(reading, 100) == b"for another command"
    os.close(reading)


def test_a_folder_that_there_is_not(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), written_whole(tmp_path / "none" / "report.html") as new:
        new.write_text("new")
