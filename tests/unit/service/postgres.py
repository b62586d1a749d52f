"""A PostgreSQL server of the tests' own: from the system's package, on a socket in a temporary folder, no network."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
from pathlib import Path

from sqlalchemy import create_engine, text


def binaries() -> Path | None:
    """The folder with initdb and postgres: Debian keeps them out of the PATH."""
    found = shutil.which("initdb")
    folders = [Path(found).parent] if found else sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    return next((folder for folder in folders if (folder / "postgres").exists()), None)


class Server:
    """Runs from its making to `close`; `stop` and `start` in between are what a test does to it.

    settings: further settings of the server, as name=value.
    """

    def __init__(self, folder_of_binaries: Path, *settings: str) -> None:
        self._settings = settings
        self._bin = folder_of_binaries
        self.folder = Path(tempfile.mkdtemp(prefix="loopwright-pg-"))
        self._user: str | None = None
        self._count = 0
        if os.getuid() == 0:  # postgres refuses to run as root
            self._user = next(user.pw_name for user in pwd.getpwall() if user.pw_name in ("postgres", "nobody"))
            shutil.chown(self.folder, self._user)
        self._data = self.folder / "data"
        self._run("initdb", "-D", str(self._data), "-U", "loopwright", "-A", "trust", "--no-sync")
        self.start()

    def start(self) -> None:
        settings = f"-k {self.folder} -c listen_addresses='' -c fsync=off -c max_connections=300"
        settings += "".join(f" -c {setting}" for setting in self._settings)
        log = str(self.folder / "log")
        self._run("pg_ctl", "-D", str(self._data), "-l", log, "-o", settings, "-w", "start")

    def stop(self) -> None:
        """As a power cut would: every connection breaks."""
        self._run("pg_ctl", "-D", str(self._data), "-m", "immediate", "-w", "stop")

    def database(self) -> str:
        """The URL of a fresh database."""
        self._count += 1
        name = f"test{self._count}"
        engine = create_engine(self._url("postgres", "postgresql+psycopg"), isolation_level="AUTOCOMMIT")
        with engine.connect() as connection:
            connection.execute(text(f"CREATE DATABASE {name}"))
        engine.dispose()
        return self._url(name, "postgresql")

    def tool(self, program: str, *arguments: str) -> None:
        """One of PostgreSQL's client programs: beside the server's, or in the PATH."""
        beside = self._bin / program
        subprocess.run([beside if beside.exists() else program, *arguments], check=True, stdin=subprocess.DEVNULL)

    def close(self) -> None:
        self.stop()
        shutil.rmtree(self.folder)

    def _url(self, name: str, driver: str) -> str:
        return f"{driver}://loopwright@/{name}?host={self.folder}"

    def _run(self, program: str, *arguments: str) -> None:
        done = subprocess.run(
            [self._bin / program, *arguments],
            user=self._user,
            cwd=self.folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,  # a pipe would stay open with the server
            stderr=subprocess.PIPE if program == "initdb" else subprocess.DEVNULL,
            text=True,
        )
        assert done.returncode == 0, f"{program}: {done.stderr}"
