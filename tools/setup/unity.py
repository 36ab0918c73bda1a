"""Fetch Unity, the C test framework, out of a Debian source package that carries it: python3 unity.py FOLDER

No binary package has it. The sources of this machine's own apt configuration are asked, as deb-src, with lists and
cache of their own, so that nothing on the system changes and root is not needed.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

PACKAGE = "ntpsec"
#: Folder of Unity in the package, and what is taken from it.
INSIDE = re.compile(r"[^/]+/tests/unity/([^/]+\.[ch])\Z")


def main() -> None:
    """Unity into the folder named on the command line."""
    target = Path(sys.argv[1])
    with tempfile.TemporaryDirectory() as scratch:
        try:
            archive = download(Path(scratch))
        except (OSError, subprocess.CalledProcessError) as error:
            detail = getattr(error, "stderr", None) or str(error)
            sys.exit(f"Cannot get Unity by apt (make UNITY_ROOT=DIR uses a copy of your own):\n{detail.strip()}")
        unpack(archive, target)


def download(scratch: Path) -> Path:
    """The upstream archive of PACKAGE, downloaded into `scratch` and checked by apt."""
    parts = scratch / "sources.list.d"
    for folder in (parts, scratch / "lists" / "partial", scratch / "cache" / "archives" / "partial"):
        folder.mkdir(parents=True)
    (scratch / "sources.list").write_text(one_line_sources())
    (parts / "deb-src.sources").write_text(deb822_sources())
    options = {
        "Dir::Etc::SourceList": scratch / "sources.list",
        "Dir::Etc::SourceParts": parts,
        "Dir::State::Lists": scratch / "lists",
        "Dir::Cache": scratch / "cache",
        "APT::Sandbox::User": "root",
        "Acquire::Languages": "none",
        "Acquire::Retries": "2",
    }
    apt = ["apt-get", "-q", *(f"-o{name}={value}" for name, value in options.items())]
    for command in (["update"], ["source", "--download-only", PACKAGE]):
        subprocess.run([*apt, *command], check=True, capture_output=True, text=True, cwd=scratch)
    return next(scratch.glob(f"{PACKAGE}_*.orig.tar.*[!c]"))


def codename() -> str:
    """Of the distribution: bookworm."""
    text = Path("/etc/os-release").read_text()
    match = re.search(r'^VERSION_CODENAME="?([\w-]+)', text, re.MULTILINE)
    return match[1] if match else ""


def ours(suites: str) -> bool:
    """Whether a source serves the distribution itself; other people's archives name suites of their own."""
    return any(suite.split("-")[0] in (codename(), "stable", "testing", "sid") for suite in suites.split())


def one_line_sources() -> str:
    """The machine's `deb` lines as `deb-src`."""
    found = []
    for file in [Path("/etc/apt/sources.list"), *sorted(Path("/etc/apt/sources.list.d").glob("*.list"))]:
        for line in file.read_text().splitlines() if file.is_file() else []:
            match = re.match(r"deb\s+(\[[^\]]*\]\s+)?(\S+)\s+(\S+)\s+\S", line)
            if match and ours(match[3]):
                found.append("deb-src" + line[3:])
    return "\n".join(found) + "\n"


def deb822_sources() -> str:
    """The machine's deb822 stanzas with type `deb-src`."""
    found = []
    flags = re.MULTILINE | re.IGNORECASE
    for file in sorted(Path("/etc/apt/sources.list.d").glob("*.sources")):
        text = "\n".join(line for line in file.read_text().splitlines() if not line.startswith("#"))
        for stanza in re.split(r"\n\s*\n", text):
            suites = re.search(r"^Suites:(.*)$", stanza, flags)
            if suites and ours(suites[1]) and not re.search(r"^Enabled:\s*no", stanza, flags):
                found.append(re.sub(r"^Types:.*$", "Types: deb-src", stanza.strip(), flags=flags))
    return "\n\n".join(found) + "\n"


def unpack(archive: Path, target: Path) -> None:
    """Unity's .c and .h files of `archive` into `target`, which appears whole or not at all."""
    fresh = target.with_name(target.name + ".part")
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    with tarfile.open(archive) as tar:
        for member in tar:
            match = INSIDE.match(member.name)
            stream = tar.extractfile(member) if match else None
            if match and stream:
                (fresh / match[1]).write_bytes(stream.read())
    if not (fresh / "unity.c").is_file():
        sys.exit(f"{archive.name} holds no Unity")
    shutil.rmtree(target, ignore_errors=True)
    fresh.rename(target)


if __name__ == "__main__":
    main()
