"""Every output file is whole or absent: nothing that goes wrong while it is written touches the older one."""

import os
import resource
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from selfcal.base.errors import UserError
from selfcal.base.output import whole, write_text


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_block_that_fails_leaves_the_older_file(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    write_text(path, "old")
    for error in (ValueError, KeyboardInterrupt):
        with pytest.raises(error), whole(path) as temporary:
            temporary.write_text("ne")
            raise error
    assert (path.read_text(), names(tmp_path)) == ("old", ["report.json"])
    write_text(path, "new")
    assert (path.read_text(), names(tmp_path)) == ("new", ["report.json"])


def test_a_killed_program_leaves_the_older_file(tmp_path: Path) -> None:
    """Killed between the first byte and the last, as by the out-of-memory killer."""
    path = tmp_path / "report.json"
    write_text(path, "old")
    code = (
        "import os, signal, sys\nfrom selfcal.base.output import whole\nwith whole(sys.argv[1]) as temporary:\n"
        "    temporary.write_text('ne')\n    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], check=False)
    assert (done.returncode, path.read_text()) == (-signal.SIGKILL, "old")


def test_a_full_disk_is_one_line_and_leaves_the_older_file(tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk: the write fails half way."""
    path = tmp_path / "report.json"
    write_text(path, "old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
        with pytest.raises(UserError, match=r"report\.json: cannot be written: File too large$"):
            write_text(path, "n" * 100_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert (path.read_text(), names(tmp_path)) == ("old", ["report.json"])


def test_permissions_and_links_stay(tmp_path: Path) -> None:
    target, link = tmp_path / "target.json", tmp_path / "link.json"
    write_text(target, "old")
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(target.stat().st_mode) == 0o666 & ~umask
    target.chmod(0o640)
    link.symlink_to("target.json")
    write_text(link, "new")
    assert link.is_symlink() and target.read_text() == "new"
    assert stat.S_IMODE(target.stat().st_mode) == 0o640


def test_streams_are_written_to(tmp_path: Path) -> None:
    """A device stays one; so does a regular file that stdout leads to, which the caller goes on writing."""
    write_text("/dev/null", "gone")
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)
    code = "from selfcal.base.output import write_text; write_text('/dev/stdout', 'one\\n'); print('two')"
    with (tmp_path / "out").open("a") as out:
        subprocess.run([sys.executable, "-c", code], stdout=out, check=True)
    assert (tmp_path / "out").read_text() == "one\ntwo\n"


def test_a_place_that_cannot_be_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"there is no folder '.*absent'; make it first$"):
        write_text(tmp_path / "absent" / "report.json", "x")
    with pytest.raises(UserError, match=r"it is a folder; give a file name$"):
        write_text(tmp_path, "x")
