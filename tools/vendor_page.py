"""Writes the libraries of the operators' page into service/api/web/static/vendor, and what the tests in a browser use
into tests/browser/vendor: `python tools/vendor_page.py`.

Needs `npm pack`. The packages have to be the ones named here, byte by byte. The result is committed; tests compare the
files with VERSIONS beside them.
"""

from __future__ import annotations

import hashlib
import re
import subprocess
import tarfile
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
OF_THE_PAGE = ROOT / "service/api/web/static/vendor"
OF_THE_TESTS = ROOT / "tests/browser/vendor"


@dataclass(frozen=True)
class Package:
    """A package. sha256: of its archive.  files: path in the archive by name in the folder."""

    name: str
    version: str
    licence: str
    sha256: str
    files: dict[str, str]


PAGE = (
    Package(
        "preact",
        "11.2.0",
        "MIT",
        "3c4456766bd32b6b534d52bf4e9c2a29b33e7eedf6e96ed479300ba1a7888ebf",
        {"preact.js": "dist/preact.mjs", "hooks.js": "hooks/dist/hooks.mjs"},
    ),
    Package(
        "@preact/signals-core",
        "1.14.5",
        "MIT",
        "94c421ac996214c94f532fb4c43d8ede048a16df0cd9538ffb965174dbe8daba",
        {"signals-core.js": "dist/signals-core.module.js"},
    ),
    Package(
        "@preact/signals",
        "2.11.4",
        "MIT",
        "66ea8221dd8aaa0da2365d49c3f116b071d56cfb63b2e16c072c6b4e08a928b7",
        {"signals.js": "dist/signals.module.js"},
    ),
    Package(
        "htm",
        "3.1.1",
        "Apache-2.0",
        "2425b9bee11409177bcabc7f32e319926fc6690c1701c0b257c88bdff2d5ba90",
        {"htm.js": "dist/htm.module.js"},
    ),
    Package(
        "uplot",
        "1.6.32",
        "MIT",
        "4b8a8191e425658e3ea8c8c1314b0fc679c861ee3a1af2b20c7b16ba50b5133d",
        {"uPlot.js": "dist/uPlot.esm.js", "uPlot.min.css": "dist/uPlot.min.css"},
    ),
    Package(
        "@fontsource-variable/inter",
        "5.3.0",
        "OFL-1.1",
        "d26710dd38e7217484a1d47ee76c024977ec550548876f26d06ed1844af09a14",
        {"inter.woff2": "files/inter-latin-wght-normal.woff2"},
    ),
)  # fmt: skip
TESTS = (
    Package(
        "axe-core",
        "4.14.1",
        "MPL-2.0",
        "e6b0ce02b84d892e2e33e403485e7f3d6c29e2be6df65daf44d89ba564139745",
        {"axe.min.js": "axe.min.js"},
    ),
)  # fmt: skip
BARE = {
    "preact": "./preact.js",
    "preact/hooks": "./hooks.js",
    "@preact/signals-core": "./signals-core.js",
}


def main() -> None:
    """Fetches the packages, checks them, and writes the files. Raises SystemExit where a package is another one."""
    for vendor, packages in ((OF_THE_PAGE, PAGE), (OF_THE_TESTS, TESTS)):
        vendor.mkdir(parents=True, exist_ok=True)
        versions, licences = [], []
        with tempfile.TemporaryDirectory() as folder:
            for package in packages:
                archive = _packed(package, Path(folder))
                for name, path in package.files.items():
                    content = _read(archive, path)
                    if packages is PAGE and not name.endswith(".woff2"):
                        content = _without_bare_imports(content.decode()).encode()
                    (vendor / name).write_bytes(content)
                    digest = hashlib.sha256(content).hexdigest()
                    versions.append(f"{name} {package.name} {package.version} {package.licence} {digest}")
                licences.append(f"{package.name} {package.version}\n\n{_read(archive, 'LICENSE').decode().strip()}\n")
        (vendor / "VERSIONS").write_text("\n".join(versions) + "\n")
        (vendor / "LICENSES").write_text(f"\n{'-' * 72}\n\n".join(licences))


def _packed(package: Package, folder: Path) -> Path:
    command = ["npm", "pack", "--silent", f"{package.name}@{package.version}"]
    name = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout.split()[-1]
    archive = folder / name
    found = hashlib.sha256(archive.read_bytes()).hexdigest()
    if found != package.sha256:
        raise SystemExit(f"{package.name} {package.version} has the SHA-256 {found}, not {package.sha256}")
    return archive


def _read(archive: Path, path: str) -> bytes:
    with tarfile.open(archive) as files:
        found = files.extractfile(f"package/{path}")
        if found is None:
            raise SystemExit(f"{archive.name} has no file {path}")
        return found.read()


def _without_bare_imports(text: str) -> str:
    """Browsers resolve bare names by an import map alone, which the page's policy would have to permit."""

    def relative(found: re.Match[str]) -> str:
        return f"{found[1]}{found[2]}{BARE[found[3]]}{found[2]}"

    text = re.sub(r"""(\bfrom\s*|\bimport\s*)(["'])([@a-z][^"'.]*)\2""", relative, text)
    return re.sub(r"\n?//# sourceMappingURL=\S+\s*", "\n", text)


if __name__ == "__main__":
    main()
