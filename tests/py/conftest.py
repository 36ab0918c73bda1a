"""What the tests share: where the real recordings are, and skipping loudly where they are not."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from selfcal.recording import Recording, load

ROOT = Path(__file__).resolve().parents[2]
#: The recordings' licence keeps them out of this repository.
SHARED_DATA = Path(os.environ.get("SELFCAL_DATA", ROOT.parent / "shared" / "data"))


def shared_recording(name: str) -> Recording:
    """A real ADIS16405 recording, or a skip that says what is missing."""
    path = SHARED_DATA / name
    if not path.exists():
        pytest.skip(f"REAL DATA ABSENT: {path} (see README, 'Real recordings')")
    return load(path)
