"""The containers of docker-compose.yml, as seen and handled by compose, the engine and the published port."""

import functools
import json
import os
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from compose_test.shell import Wrong, output, read_all, tell, until, works

IMAGE = "loopwright-compose-test"
PROJECT = "loopwright-compose-test"
DEVICES = ("bus", "plant", "controller", "service")
UP_S = 120.0
MINE = f"label=com.docker.compose.project={PROJECT}"


@functools.cache
def _compose() -> tuple[str, ...]:
    return ("docker", "compose") if works("docker", "compose", "version") else ("docker-compose",)


def compose(*words: str, check: bool = True, timeout: float = 600.0) -> str:
    start = _compose()
    if check:
        tell("$ docker compose " + " ".join(words))
        return output(*start, *words, timeout=timeout)
    return read_all(*start, *words, timeout=timeout)


def container(service: str) -> str:
    its = f"label=com.docker.compose.service={service}"
    return output("docker", "ps", "--all", "--quiet", "--filter", MINE, "--filter", its).split()[0]


def logs(service: str) -> str:
    return read_all("docker", "logs", container(service))


def inspect(service: str, what: str) -> str:
    return output("docker", "inspect", "--format", what, container(service)).strip()


def signalled(service: str, since: float) -> float:
    """When the engine has first sent a signal to a container since a time, both in seconds of the Unix clock."""
    between = ("--since", f"{since:.9f}", "--until", f"{time.time():.9f}")
    its = ("--filter", f"container={container(service)}", "--filter", "event=kill")
    sent = output("docker", "events", *between, *its, "--format", "{{.TimeNano}}").split()
    if not sent:
        raise Wrong(f"the engine has sent no signal to {service}")
    return int(sent[0]) / 1e9


def in_image(*command: str, options: Sequence[str] = ()) -> str:
    """What a command says in a container of the image, without a network."""
    return output("docker", "run", "--rm", "--network", "none", *options, IMAGE, *command)


def healthy(before: Mapping[str, str] = MappingProxyType({}), names: Sequence[str] = DEVICES) -> bool:
    """All of them; those in `before` started anew since that time."""
    now = states()
    return all(now[name][1] == "healthy" for name in names) and all(now[name][0] > at for name, at in before.items())


def wait_healthy(names: Sequence[str] = DEVICES) -> None:
    until(f"healthy: {', '.join(names)}", lambda: healthy(names=names), UP_S)


def states() -> dict[str, tuple[str, str]]:
    """When each container was started, and its health, by two calls: each of them is dear in user-mode Linux."""
    mine = output("docker", "ps", "--all", "--quiet", "--filter", MINE).split()
    form = '{{index .Config.Labels "com.docker.compose.service"}} {{.State.StartedAt}} '
    form += "{{with .State.Health}}{{.Status}}{{end}}"
    rows = [line.split(" ") for line in output("docker", "inspect", "--format", form, *mine).splitlines()]
    return {name: (at, health) for name, at, health in rows}


def started_at() -> dict[str, str]:
    return {name: at for name, (at, _) in states().items()}


def wait_for(service: str, patience_s: float) -> int:
    """The exit status of a container that ends by itself."""
    until(f"the end of {service}", lambda: inspect(service, "{{.State.Status}}") == "exited", patience_s)
    return int(inspect(service, "{{.State.ExitCode}}"))


def memory(names: Sequence[str]) -> str:
    form = "{{.MemUsage}}"
    used = output("docker", "stats", "--no-stream", "--format", form, *map(container, names)).splitlines()
    return ", ".join(f"{name} {line.split(' /')[0]}" for name, line in zip(names, used, strict=True))


def nothing_left() -> str:
    """The containers, volumes and networks of ours that are still there."""
    kinds = (("ps", "--all"), ("volume", "ls"), ("network", "ls"))
    return "".join(output("docker", *kind, "--quiet", "--filter", MINE) for kind in kinds)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as found:
        return int(found.getsockname()[1])


def ask(path: str, body: dict[str, Any] | None = None, port: str = "LOOPWRIGHT_PORT") -> Any:
    """A service's answer, through its published port."""
    url = f"http://127.0.0.1:{os.environ[port]}{path}"
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(url, data, {"Content-Type": "application/json"})
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(request, timeout=30.0) as answer:
            return json.load(answer)
    except urllib.error.HTTPError as error:
        raise Wrong(f"{path}: {error.read().decode()}") from error
