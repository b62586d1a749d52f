"""A real vcan0 where the kernel has none: the same engine, with the same images, inside user-mode Linux."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from compose_test.engine import end, engine
from compose_test.scenario import scenario
from compose_test.shell import Wrong, output

_MODULES = (
    "fs/overlayfs/overlay", "drivers/net/veth", "lib/crc-ccitt", "net/ipv6/ipv6", "net/llc/llc", "net/802/stp",
    "net/bridge/bridge", "drivers/block/loop",
)  # fmt: skip
_CGROUPS = ("cpu", "cpuacct", "memory", "devices", "pids", "freezer")
_MAX_S = 2400


def vcan_in_guest(folder: Path, own: "subprocess.Popen[bytes]", briefly: bool) -> None:
    """The engine's data on a disk image that the guest mounts: it need not unpack the images again."""
    output("docker", "image", "prune", "--force")
    end(own)
    disk = folder / "disk"
    output("mkfs.ext4", "-q", "-d", str(folder / "data"), str(disk), "4G")
    shutil.rmtree(folder / "data")
    tool = [sys.executable, "tools/compose-test", "--guest", str(disk), *(["--only", "vcan"] if not briefly else [])]
    if subprocess.run(["tools/with-vcan", "--timeout", str(_MAX_S), "--", *tool], check=False).returncode != 0:
        raise Wrong("on vcan, inside user-mode Linux: see above")


def in_guest(disk: str, briefly: bool) -> None:
    os.environ["PATH"] = "/usr/local/sbin:/usr/sbin:/sbin:" + os.environ["PATH"]
    folder = Path("/run/engine")
    (folder / "data").mkdir(parents=True)
    modules = next(Path("/usr/lib/uml/modules").glob("*/kernel"))
    output(sys.executable, "tools/with-vcan", "--load", *(f"{modules}/{name}.ko" for name in _MODULES))
    output("mount", "-t", "tmpfs", "cgroup", "/sys/fs/cgroup")
    for name in _CGROUPS:
        os.mkdir(f"/sys/fs/cgroup/{name}")
        output("mount", "-t", "cgroup", "-o", name, "cgroup", f"/sys/fs/cgroup/{name}")
    for number in range(2):
        if not os.path.exists(f"/dev/loop{number}"):
            os.mknod(f"/dev/loop{number}", 0o660 | 0o60000, os.makedev(7, number))
    output("losetup", "/dev/loop0", disk)
    output("mount", "/dev/loop0", str(folder / "data"))
    # One processor, and dear processes: few health checks, 70 samples in an ultimate period instead of 170, and a plant
    # at full speed for the first demo alone.
    os.environ |= {"LOOPWRIGHT_HEALTH": "10s", "LOOPWRIGHT_SPEED": "5", "LOOPWRIGHT_TS": "0.05"}
    with engine(folder):
        scenario("vcan", briefly=briefly)
