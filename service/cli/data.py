"""`loopwright backup`, `loopwright restore` and `loopwright check-data`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from loopwright.service.cli.output import die

app = typer.Typer()

Data = Annotated[Path, typer.Option(help="The service's data folder.")]


@app.command()
def backup(
    file: Annotated[Path, typer.Argument(help="Where to write the back-up.")],
    data: Data = Path("data"),
    replace: Annotated[bool, typer.Option("--replace", help="Write over an existing file.")] = False,
) -> None:
    """Copies the data folder's database while the service runs: jobs, samples, keys, audit log."""
    from loopwright.service.store.backup import BackupProblem, back_up

    _only_files()
    try:
        size = back_up(data, file, replace)
    except (BackupProblem, OSError) as error:
        die(str(error), 2)
    print(f"{file}: {size} bytes, checked")


@app.command()
def restore(
    file: Annotated[Path, typer.Argument(help="The back-up.")],
    data: Data = Path("data"),
    replace: Annotated[
        bool, typer.Option("--replace", help="Move the present data aside, and restore the back-up.")
    ] = False,
) -> None:
    """Restores a back-up as the data of a stopped service. Jobs that were active in the back-up end as interrupted."""
    from loopwright.service.store.backup import BackupProblem
    from loopwright.service.store.backup import restore as run
    from loopwright.service.store.lock import FolderInUse

    _only_files()
    try:
        interrupted, aside = run(file, data, replace)
    except FolderInUse:
        die(f"a service is running on {data}: stop it first", 2)
    except (BackupProblem, OSError) as error:
        die(str(error), 2)
    print(f"restored {file} to {data}; {interrupted} job(s) that were active in the back-up are marked interrupted")
    if aside is not None:
        print(f"the previous data are in {aside}")
    print("the keys are those of the back-up: see loopwright key list")


@app.command("check-data")
def check_data(
    data: Data = Path("data"),
    salvage: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Copy the readable rows into a new file, for restore.")
    ] = None,
) -> None:
    """Reports which data can be read, and changes nothing. Exit status 0: all data, 3: some data are damaged."""
    from loopwright.service.store.check_data import CheckProblem
    from loopwright.service.store.check_data import check_data as check
    from loopwright.service.store.check_data import salvage as copy
    from loopwright.service.store.lock import FolderInUse

    _only_files()
    try:
        reports = check(data)
        copied = copy(data, salvage) if salvage is not None else {}
    except FolderInUse:
        die(f"a service is running on {data}: stop it before its data are copied", 2)
    except (CheckProblem, OSError) as error:
        die(str(error), 2)
    for report in reports:
        rows = ", ".join(f"{table} {count}" for table, count in report.rows.items())
        print(f"{report.file}: {'damaged' if report.wrong else 'whole'}; readable rows: {rows or 'none'}")
        for line in (*report.wrong, *report.notes):
            print(f"  {line}")
    if salvage is not None:
        print(f"{salvage}: {', '.join(f'{table} {count}' for table, count in copied.items())}")
        print(f"restore it with: loopwright restore {salvage} --data {data} --replace")
    if any(report.wrong for report in reports):
        if salvage is None:
            print(
                f"Stop the service and restore the last back-up: loopwright restore FILE --data {data} --replace\n"
                f"or restore the readable rows: loopwright check-data --data {data} --salvage FILE\n"
                "A damaged engine.sqlite is created again at the next start: no job or sample is lost with it."
            )
        raise typer.Exit(3)


def _only_files() -> None:
    if os.environ.get("LOOPWRIGHT_DATABASE"):
        die("LOOPWRIGHT_DATABASE is set: a shared database is backed up and restored with pg_dump and pg_restore", 2)
