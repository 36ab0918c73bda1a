"""Fetch Unity, the C test framework, out of a Debian source package that carries it: python3 unity.py FOLDER

Its files are taken if they are, byte for byte, those of a release that is stated here.

No binary package has it. The sources of this machine's own apt configuration are asked, as deb-src, with lists and
cache of their own, so that nothing on the system changes and root is not needed.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

PACKAGE = "ntpsec"
#: What is taken from the package's folder tests/unity, and its SHA-256 in the package's releases.
FILES = {
    "1.2.2 (Debian 12)": {
        "unity.c": "2e3a0610268455520a5796345b503d00c34a47fe97ed3750349cbd4b2b1990f3",
        "unity.h": "681ac98a63ac11effb11e59d580f6ca82abca1bd34069465c38e3b15344256c0",
        "unity_internals.h": "adfd612c217e59468c5ebe978640e77e5f539e820ffc0c195a98c5a36f0ac868",
    },
    "1.2.3 and 1.2.4 (Debian 13)": {
        "unity.c": "5570269535c6bcf7e8cdc5f96f650ff25e6a8bb889b86f85296c17683b0832fd",
        "unity.h": "c5f8f6458ed9d380fde28421a50ca1aea1861484d625ca4f224c1f7246c25eb0",
        "unity_internals.h": "6f8ebe5f102269d3bfbbd19198e45b37d92255a85f9d604091c49c535d15a950",
    },
}


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
    sources = []
    for file in [Path("/etc/apt/sources.list"), *sorted(Path("/etc/apt/sources.list.d").glob("*.list"))]:
        for line in file.read_text().splitlines() if file.is_file() else []:
            match = re.match(r"deb\s+(\[[^\]]*\]\s+)?(\S+)\s+(\S+)\s+\S", line)
            if match and ours(match[3]):
                sources.append("deb-src" + line[3:])
    return "\n".join(sources) + "\n"


def deb822_sources() -> str:
    """The machine's deb822 stanzas with type `deb-src`."""
    stanzas = []
    flags = re.MULTILINE | re.IGNORECASE
    for file in sorted(Path("/etc/apt/sources.list.d").glob("*.sources")):
        text = "\n".join(line for line in file.read_text().splitlines() if not line.startswith("#"))
        for stanza in re.split(r"\n\s*\n", text):
            suites = re.search(r"^Suites:(.*)$", stanza, flags)
            if suites and ours(suites[1]) and not re.search(r"^Enabled:\s*no", stanza, flags):
                stanzas.append(re.sub(r"^Types:.*$", "Types: deb-src", stanza.strip(), flags=flags))
    return "\n\n".join(stanzas) + "\n"


def unpack(archive: Path, target: Path) -> None:
    """Unity's files of `archive` into `target`, which appears whole or not at all. Exits if they are not as stated."""
    names = {name for files in FILES.values() for name in files}
    files: dict[str, bytes] = {}
    with tarfile.open(archive) as tar:
        for member in tar:
            match = re.fullmatch(r"[^/]+/tests/unity/([^/]+)", member.name)
            if match and match[1] in names and member.isfile():
                stream = tar.extractfile(member)
                assert stream is not None
                files[match[1]] = stream.read()
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    if digests not in FILES.values():
        sys.exit(
            f"{archive.name} holds no Unity of a stated SHA-256 (tools/setup/unity.py); a Unity that you trust: "
            "make UNITY_ROOT=DIR"
        )
    fresh = target.with_name(target.name + ".part")
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    for name, content in files.items():
        (fresh / name).write_bytes(content)
    shutil.rmtree(target, ignore_errors=True)
    fresh.rename(target)


if __name__ == "__main__":
    main()
