"""Data volumes that are not as the service left them: of an older version, of a newer one, not writable."""

from compose_test.loop import TAG, in_automatic
from compose_test.shell import check, expect, tell, until
from compose_test.stack import PROJECT, ask, compose, in_image, logs, wait_healthy

# As the first version left it when it was cut off: its tables, and a job that runs.
_OLD = f"""
import shutil
from pathlib import Path
from alembic import command
from alembic.config import Config
from loopwright.service.store.database import FILE, sqlite
for path in Path("/data").iterdir():
    shutil.rmtree(path) if path.is_dir() else path.unlink()
config = Config()
config.set_main_option("script_location", "loopwright.service.store:migrations")
with sqlite(Path("/data") / FILE).begin() as connection:
    config.attributes["connection"] = connection
    command.upgrade(config, "0001")
    connection.exec_driver_sql(
        "INSERT INTO jobs (id, loop, state, dry_run, request, requested_by, created_at, plant_time_s)"
        " VALUES ('0123456789ab', '{TAG}', 'running', 0, '{{}}', 'the first version', '2020-01-01T00:00:00.000Z', 12.0)"
    )
"""
_REVISION = """
import sqlite3, sys
with sqlite3.connect("/data/loopwright.sqlite") as made:
    print(made.execute("SELECT version_num FROM alembic_version").fetchone()[0])
    if sys.argv[1:]:
        made.execute("UPDATE alembic_version SET version_num = ?", sys.argv[1:])
"""


def volumes() -> None:
    compose("stop", "service")
    _in_volume("python", "-c", _OLD)
    before = _revision()
    _up()
    job = ask("/jobs/0123456789ab")
    tell(f"old volume  revision {before} -> {_revision()}; its job {job['state']}: {job['detail']}")
    check("data volume of the first version, with a job that ran", job["state"] == "interrupted", str(job))

    compose("stop", "service")
    revision = _revision("9999")
    _refused("data volume of a newer version", "made by a newer version")
    _revision(revision)
    _up()

    compose("stop", "service")
    _in_volume("chown", "--recursive", "0:0", "/data", user="0:0")
    _refused("data volume not writable", "/data: Permission denied")
    _in_volume("chown", "--recursive", "10001:10001", "/data", user="0:0")
    _up()
    check("what was in it is still there", ask("/jobs/0123456789ab") == job)


def _up() -> None:
    compose("up", "--detach", "service")
    wait_healthy()
    until("the loop in automatic", in_automatic, 60.0)


def _refused(what: str, word: str) -> None:
    compose("up", "--detach", "service")
    until(f"{what}, in the log", lambda: word in logs("service"), 60.0)
    expect(what, logs("service"), word)
    compose("stop", "service")


def _in_volume(*command: str, user: str = "10001:10001") -> str:
    return in_image(*command, options=("--user", user, "--volume", f"{PROJECT}_data:/data")).strip()


def _revision(*wanted: str) -> str:
    return _in_volume("python", "-c", _REVISION, *wanted)
