"""What `lib/` has as a package, from its sources: default tables, the version in each manifest, the licence.

python -m selfcal.wire.package_codegen    write lib/default/, the versions in lib/'s manifests, and lib/LICENSE
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from selfcal.base.errors import UserError
from selfcal.model.file import Model
from selfcal.model.tables import make_tables
from selfcal.wire.c_tables import write_tables
from selfcal.wire.frames import ROOT

#: Core that the default tables are for: a package goes into firmware.
TARGET = "cortex-m4f"
#: Manifests that must state the version themselves, and how. CMake and pkg-config read it from lib/selfcal.h.
VERSIONS = {
    "library.json": re.compile(r'(?<="version": ")[^"]*'),
    "library.properties": re.compile(r"(?<=^version=).*$", re.MULTILINE),
    "idf_component.yml": re.compile(r'(?<=^version: ")[^"]*', re.MULTILINE),
}


def version(library: Path) -> str:
    """SELFCAL_VERSION. Raises UserError where lib/selfcal.h has none."""
    defined = re.search(r'^#define SELFCAL_VERSION "([^"]+)"', (library / "selfcal.h").read_text("utf-8"), re.MULTILINE)
    if defined is None:
        raise UserError(f"{library / 'selfcal.h'}: no SELFCAL_VERSION")
    return defined[1]


def write(library: Path) -> None:
    """Write all into `library`, a folder like lib/. Raises UserError for a manifest without a version."""
    model = Model.load(None)
    write_tables(model, make_tables(model, model.sensor_rate_hz, None, TARGET), library / "default", TARGET)
    for name, pattern in VERSIONS.items():
        text, count = pattern.subn(version(library), (library / name).read_text("utf-8"))
        if count != 1:
            raise UserError(f"{library / name}: {count} lines with a version, not one")
        (library / name).write_text(text, encoding="utf-8")
    shutil.copyfile(ROOT / "LICENSE", library / "LICENSE")


if __name__ == "__main__":
    write(ROOT / "lib")
