"""Data volumes that are not as the service left them: never released, of a newer version, not writable."""

from compose_test.loop import in_automatic
from compose_test.shell import check, expect, until
from compose_test.stack import PROJECT, ask, compose, in_image, logs, wait_healthy

_REVISION = """
import sqlite3, sys
with sqlite3.connect("/data/loopwright.sqlite") as made:
    print(made.execute("SELECT version_num FROM alembic_version").fetchone()[0])
    if sys.argv[1:]:
        made.execute("UPDATE alembic_version SET version_num = ?", sys.argv[1:])
"""


def volumes() -> None:
    job = ask("/jobs?limit=1")
    compose("stop", "service")
    revision = _revision("0018")
    _refused("data volume from before the first release", "from before 0.1.0")
    _revision("9999")
    _refused("data volume of a newer version", "made by a newer version")
    _revision(revision)
    _up()

    compose("stop", "service")
    _in_volume("chown", "--recursive", "0:0", "/data", user="0:0")
    _refused("data volume not writable", "/data: Permission denied")
    _in_volume("chown", "--recursive", "10001:10001", "/data", user="0:0")
    _up()
    check("what was in it is still there", ask("/jobs?limit=1") == job)


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
