"""A container engine of the test's own, and a base image where no registry answers."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from compose_test.shell import Wrong, output, tell, until, works

REGISTRY_IMAGE, LOCAL_IMAGE = "python:3.12-slim", "local/python:bookworm"
PACKAGES = "python3,python3-venv,ca-certificates"
# No network of the host is touched, and no container of another engine, should they share a containerd.
OPTIONS = (
    "--iptables=false", "--ip6tables=false", "--ip-forward=false", "--ip-masq=false", "--bridge=none",
    "--storage-driver=overlay2", "--containerd-namespace=compose-test",
    "--containerd-plugins-namespace=compose-test-plugins",
)  # fmt: skip
# Control groups, version 1. On version 2 the system's own slices see to it.
_PROCESSOR = Path("/sys/fs/cgroup/cpu")
_GROUP = "loopwright-compose-test"
_PROCESSES = 6


@contextlib.contextmanager
def fair_share() -> Iterator[None]:
    """This test with all that it starts gets the processor time of so many processes. The kernel else counts all the
    containers of an engine as one, and beside a few busy processes a device misses its heartbeat of one second."""
    group = _PROCESSOR / _GROUP
    try:
        group.mkdir(exist_ok=True)
        (group / "cpu.shares").write_text(str(1024 * _PROCESSES))
        (group / "cgroup.procs").write_text(str(os.getpid()))
    except OSError:  # not ours to give
        yield
        return
    try:
        yield
    finally:
        (_PROCESSOR / "cgroup.procs").write_text(str(os.getpid()))
        for one in _PROCESSOR.parent.glob(f"*/{_GROUP}"):
            with contextlib.suppress(OSError):
                one.rmdir()


def can_start() -> bool:
    """Unless the environment names an engine to use."""
    return "DOCKER_HOST" not in os.environ and os.geteuid() == 0 and shutil.which("dockerd") is not None


@contextlib.contextmanager
def engine(folder: Path) -> Iterator["subprocess.Popen[bytes]"]:
    """An engine on a private socket in `folder`, which DOCKER_HOST then names; it ends, with all it ran, on leaving."""
    words, key = folder / "engine.log", Path("/etc/docker/key.json")
    had_key = key.exists()
    with open(words, "ab") as log:
        command = [
            "dockerd", *OPTIONS, "--data-root", f"{folder}/data", "--exec-root", f"{folder}/exec",
            "--host", f"unix://{folder}/socket", "--pidfile", f"{folder}/pid",
            *([f"--cgroup-parent=/{_GROUP}"] if (_PROCESSOR / "cpu.shares").exists() else []),
        ]  # fmt: skip
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
    os.environ["DOCKER_HOST"] = f"unix://{folder}/socket"
    try:
        until("the engine", lambda: process.poll() is not None or works("docker", "info"), 60.0)
        if process.poll() is not None:
            lines = [line for line in words.read_text(errors="replace").splitlines() if "level=info" not in line]
            last = "\n".join(lines[-5:])
            raise Wrong(f"dockerd ended with status {process.returncode}; its last words:\n{last}")
        yield process
    finally:
        end(process)
        for name in (*(folder / "exec/netns").glob("*"), folder / "data"):  # what an engine may leave mounted
            works("umount", str(name))
        if not had_key:
            key.unlink(missing_ok=True)
        del os.environ["DOCKER_HOST"]


def end(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    try:
        process.wait(30.0)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def base_image(folder: Path) -> str:
    """The one asked for, the registry's, or one made of Debian packages."""
    if "BASE_IMAGE" in os.environ:
        return os.environ["BASE_IMAGE"]
    if works("docker", "image", "inspect", REGISTRY_IMAGE) or works("docker", "pull", "--quiet", REGISTRY_IMAGE):
        return REGISTRY_IMAGE
    if works("docker", "image", "inspect", LOCAL_IMAGE):
        return LOCAL_IMAGE
    if os.geteuid() != 0 or shutil.which("debootstrap") is None:
        raise Wrong(f"no registry has {REGISTRY_IMAGE}: name a base image in BASE_IMAGE, or (root) install debootstrap")
    started, root = time.monotonic(), folder / "root"
    try:
        output("debootstrap", "--variant=minbase", f"--include={PACKAGES}", "bookworm", str(root), _debian_mirror())
    finally:
        for name in ("proc", "sys"):  # mounted still, if it was cut off
            works("umount", str(root / name))
    for name in root.glob("usr/lib/python3*/EXTERNALLY-MANAGED"):
        name.unlink()
    (root / "usr/bin/python").symlink_to("python3")
    for name in root.glob("var/cache/apt/archives/*.deb"):
        name.unlink()
    shutil.rmtree(root / "var/lib/apt/lists")
    authorities = "/etc/ssl/certs/ca-certificates.crt"
    if os.path.exists(authorities):
        shutil.copy(authorities, f"{root}{authorities}")
    (root / "etc/pip.conf").write_text(_pip_settings(authorities))
    output("sh", "-c", f"tar -C {root} -c . | docker import - {LOCAL_IMAGE}")
    shutil.rmtree(root)
    tell(f"base image  {LOCAL_IMAGE}, made by debootstrap in {time.monotonic() - started:.0f} s")
    return LOCAL_IMAGE


def _debian_mirror() -> str:
    """The one that this machine's own apt uses."""
    for name in (*Path("/etc/apt/sources.list.d").glob("*.sources"), Path("/etc/apt/sources.list")):
        for line in name.read_text().splitlines() if name.exists() else ():
            words = line.split()
            if words[:1] in (["URIs:"], ["deb"]):
                return next(word for word in words if word.startswith("http"))
    raise Wrong("apt has no package source here, and the base image needs one; see sources.list(5)")


def _pip_settings(authorities: str) -> str:
    """This machine's index, as far as it is one that a container can reach."""
    lines = ["[global]", f"cert = {authorities}"]
    found = subprocess.run([sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True, check=False)
    for line in found.stdout.splitlines():
        name, _, value = line.partition("=")
        if name in ("global.index-url", ":env:.index-url"):
            lines.append(f"index-url = {value.strip(chr(39))}")
    return "\n".join(lines) + "\n"
