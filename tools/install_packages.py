"""Installs this repository with the extras EXTRAS into the environment that runs this: install_packages.py EXTRAS

uv does it, which takes a tenth of pip's time. uv comes by the pip that every Python has in a wheel (ensurepip), and is
given pip's configuration, which it does not read. Where uv cannot be had, or fails, pip does it. Standard library only.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
CONSTRAINTS = ROOT / "constraints.txt"
QUIET = "-qq"  # of pip: errors alone. What pip would warn of is in pinned packages of others.


def uv_settings(pip_config: str) -> dict[str, str]:
    """The environment variables that tell uv what the output of `pip config list` says.

    Several values are separated by white space in pip's, and in uv's but for the places of wheels.
    """
    pip: dict[str, str] = {}
    for line in pip_config.splitlines():
        name, equals, value = line.partition("=")
        where, _, key = name.rpartition(".")
        if equals and where in ("global", "install", ":env:"):
            pip[key] = " ".join(str(ast.literal_eval(value)).split())
    settings = {
        variable: pip[key]
        for key, variable in {
            "index-url": "UV_DEFAULT_INDEX",
            "extra-index-url": "UV_INDEX",
            "no-index": "UV_NO_INDEX",
            "constraint": "UV_CONSTRAINT",
            "trusted-host": "UV_INSECURE_HOST",
            "timeout": "UV_HTTP_TIMEOUT",
            "default-timeout": "UV_HTTP_TIMEOUT",
            "cert": "SSL_CERT_FILE",
            "client-cert": "SSL_CLIENT_CERT",
            "proxy": "ALL_PROXY",
        }.items()
        if key in pip
    }
    if "find-links" in pip:
        settings["UV_FIND_LINKS"] = pip["find-links"].replace(" ", ",")
    # As pip does, the best version of all places is taken.
    return settings | {"UV_INDEX_STRATEGY": "unsafe-best-match"}


def bundled_pip() -> Path | None:
    """The wheel of pip that comes with Python, which runs without being installed."""
    import ensurepip

    folders = [Path(ensurepip.__file__).parent / "_bundled", sysconfig.get_config_var("WHEEL_PKG_DIR")]
    return next((wheel for folder in folders if folder for wheel in Path(folder).glob("pip-*.whl")), None)


def by_uv(pip_wheel: Path, package: str, environment: Mapping[str, str]) -> bool:
    """Installs the package; whether that went well."""
    pip = (sys.executable, "-m", "pip")
    with_pip = {**environment, "PYTHONPATH": str(pip_wheel), "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    uv = Path(sys.executable).with_name("uv")
    if not uv.exists():
        get = [*pip, "install", QUIET, "--no-deps", "--no-compile", "--constraint", str(CONSTRAINTS), "uv"]
        if subprocess.run(get, env=with_pip, stderr=subprocess.DEVNULL, check=False).returncode:
            return False
    config = subprocess.run([*pip, "config", "list"], env=with_pip, capture_output=True, text=True, check=False).stdout
    install = [uv, "pip", "install", "--quiet", "--python", sys.executable]
    install += ["--constraint", str(CONSTRAINTS), "--editable", package]
    try:
        done = subprocess.run(install, env={**uv_settings(config), **environment}, capture_output=True, check=False)
    except OSError:
        return False
    return done.returncode == 0


def by_pip(package: str, environment: Mapping[str, str]) -> int:
    """Installs the package; the status."""
    if subprocess.run([sys.executable, "-m", "pip", "--version"], capture_output=True, check=False).returncode:
        status = subprocess.call([sys.executable, "-m", "ensurepip"], stdout=subprocess.DEVNULL)
        if status:
            return status
    install = [sys.executable, "-m", "pip", "install", QUIET, "--constraint", str(CONSTRAINTS), "--editable", package]
    return subprocess.call(install, env={**environment, "PIP_DISABLE_PIP_VERSION_CHECK": "1"})


def main(extras: str) -> int:
    package = f"{ROOT}[{extras}]"
    pip_wheel = bundled_pip()
    if pip_wheel is not None and by_uv(pip_wheel, package, os.environ):
        return 0
    return by_pip(package, os.environ)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
