"""`loopwright key`: creates, lists and revokes API keys, on the machine that has the data folder."""

from __future__ import annotations

import json
import sys
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from loopwright.service.cli.output import die, user
from loopwright.service.security.keys import Scope

if TYPE_CHECKING:
    from loopwright.service.store.keyring import Keyring

app = typer.Typer(help="Create, list and revoke API keys.", no_args_is_help=True)

Data = Annotated[Path, typer.Option(help="The service's data folder.")]
Database = Annotated[
    str | None, typer.Option(envvar="LOOPWRIGHT_DATABASE", help="The shared database; default: a file in the folder.")
]
AsJson = Annotated[bool, typer.Option("--json", help="JSON, for scripts.")]


@app.command()
def create(
    name: Annotated[str, typer.Argument(help="Owner of the key; the audit log shows the name.")],
    scope: Annotated[
        Scope, typer.Option(help="read: only read; operate: also retune and decide; admin: also read the audit log.")
    ],
    days: Annotated[
        int | None, typer.Option(min=1, max=36_500, help="Days that the key is valid; default: for ever.")
    ] = None,
    data: Data = Path("data"),
    database: Database = None,
    as_json: AsJson = False,
) -> None:
    """Creates a key and shows it, only this once."""
    if not name.strip() or len(name) > 100 or not name.isprintable():
        die("a name has 1 to 100 printable characters", 2)
    with _Keys(data, database, make=True) as keys:
        row, key = keys.create(name, scope, timedelta(days=days) if days else None)
    if as_json:
        print(json.dumps({"id": row.id, "name": name, "scope": scope.value, "expires_at": row.expires_at, "key": key}))
        return
    print(key)
    print("The key is shown only this once. Use it as: export LOOPWRIGHT_KEY=...", file=sys.stderr)


@app.command("list")
def list_keys(data: Data = Path("data"), database: Database = None, as_json: AsJson = False) -> None:
    """Lists all keys, also revoked and expired ones. The secrets are not stored."""
    from loopwright.service.store.keyring import valid

    with _Keys(data, database) as keys:
        rows = keys.list()
    names = ("id", "name", "scope", "created_at", "expires_at", "revoked_at")
    found = [{**{name: getattr(row, name) for name in names}, "valid": valid(row)} for row in rows]
    if as_json:
        print(json.dumps(found, indent=2))
        return
    from loopwright.service.cli import terminal

    terminal.rows("keys", (*names, "valid"), (tuple(row.values()) for row in found))


@app.command()
def revoke(
    key: Annotated[str, typer.Argument(metavar="ID|NAME", help="Id or name of the key.")],
    data: Data = Path("data"),
    database: Database = None,
) -> None:
    """Revokes a key; a running service accepts it for at most 2 s more."""
    with _Keys(data, database) as keys:
        row = keys.revoke(key)
    print(f"revoked {row.id} ({row.name})")


class _Keys:
    """Opens the keyring of a service in the name of the user; an error ends the command."""

    def __init__(self, data: Path, database: str | None, make: bool = False) -> None:
        from sqlalchemy.exc import SQLAlchemyError

        from loopwright.service.security.principal import Principal, current
        from loopwright.service.store.database import FILE, BadDatabase, migrate, open_database
        from loopwright.service.store.keyring import Keyring

        if database is None and make:
            try:
                data.mkdir(mode=0o700, parents=True, exist_ok=True)
            except OSError as error:
                die(f"{data} cannot be the data folder of a service: {error.strerror}", 2)
        elif database is None and not (data / FILE).exists():
            die(f"{data} is not a data folder of a service: it has no {FILE}", 2)
        try:
            self._engine = open_database(data, database, "loopwright key")
            migrate(self._engine)
        except BadDatabase as error:
            die(str(error), 2)
        except SQLAlchemyError as error:
            die(f"the database cannot be used: {getattr(error, 'orig', None) or error}", 2)
        self._keyring = Keyring(self._engine)
        current.set(Principal(user(), Scope.ADMIN))

    def __enter__(self) -> Keyring:
        return self._keyring

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        from loopwright.service.store.keyring import KeyProblem

        self._engine.dispose()
        if isinstance(error, KeyProblem):
            die(str(error), 2)
