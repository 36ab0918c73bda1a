"""Holes of files: a diagnosis that lies, names that hold line feeds, a writer that is killed. Many in `make cases`."""

from __future__ import annotations

import copy
import json
import os
import random
import re
import signal
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
import yaml

from selfcal.base.errors import UserError, remark
from selfcal.diagnosis.extend import model_text
from selfcal.diagnosis.warm import load_start
from selfcal.logs.recording import load, save
from selfcal.model.file import DEFAULT, Model
from selfcal.model.tables import make_tables
from selfcal.show.export import FORMS, write_export
from selfcal.verbs.codegen import codegen
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify
from selfcal.wire.c_tables import bank_bytes, write_tables
from selfcal.wire.dbc_file import Names, dbc_text

from conftest import ROOT, case_records

# ------------------------------------------------------------------------------------------------ a diagnosis that lies


@dataclass(frozen=True)
class Part:
    """A diagnosis, the model that goes with it, and the answer of `identify`, all of one record."""

    diagnosis: Path
    model: Model
    answer: dict[str, Any]


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> Part:
    """Ten minutes of a gyro with a temperature coefficient, and of an accelerometer, 1 Hz."""
    folder = tmp_path_factory.mktemp("part")
    rng = np.random.default_rng(17)
    temp = 25.0 + np.cumsum(rng.normal(size=600)) * 0.2
    gx, ax = 0.04 * rng.normal(size=600) + 0.02 * (temp - 25.0), 5e-3 * rng.normal(size=600)
    save(folder / "log.npz", {"gx": ("deg/s", gx), "ax": ("m/s^2", ax), "temp": ("degC", temp)}, 1.0, {})
    diagnose(folder / "log.npz", axes=("gx",), json=folder / "d.json", write_model=folder / "m.yaml")
    return Part(folder / "d.json", Model.load(folder / "m.yaml"), identify(folder / "log.npz", axes=("gx", "ax")))


def places(tree: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where a tree has values, mappings and lists among them."""
    if at:
        yield at
    if isinstance(tree, dict):
        for key in tree:
            yield from places(tree[key], (*at, key))
    elif isinstance(tree, list):
        for k, one in enumerate(tree):
            yield from places(one, (*at, k))


def put(tree: Any, at: tuple[Any, ...], value: Any) -> Any:
    """A copy of the tree with another value at a place."""
    made = copy.deepcopy(tree)
    inside = made
    for key in at[:-1]:
        inside = inside[key]
    inside[at[-1]] = value
    return made


#: What no reader of a diagnosis may stumble over.
HOSTILE = [
    10**400, -(10**400), 10**308, 2**63, 1, 0, -1, 0.5, 1e308, -1e308, 5e-324, float("nan"), float("inf"),
    None, True, False, "", "gx", "x" * 300, "a\nb", "\x1b[2J", "\ud800", [], [1], [[]], {}, {"a": 1}, {"": {}},
    {"mean": 1}, {"N": 1}, {"law": "log-uniform"}, [None] * 3,
]  # fmt: skip


def refused(part: Part, tree: Any, path: Path) -> str:
    """The line of what is refused; empty if it is taken. Anything else fails."""
    path.write_text(json.dumps(tree), encoding="utf-8")
    try:
        start = load_start(path, part.model)
        start.applied(make_tables(part.model, 1.0, ("gx",)))
    except UserError as error:
        said = str(error)
        assert said.startswith(str(path)) and "\n" not in said and len(said) < 1000, said
        return said
    return ""


def test_a_changed_diagnosis_is_refused_in_one_line(part: Part, tmp_path: Path) -> None:
    """Each place that is read with values that cannot be there: no traceback. The two of the report come first."""
    tree = json.loads(part.diagnosis.read_text())
    path = tmp_path / "d.json"
    assert refused(part, tree, path) == ""
    law = max(tree["axes"]["gx"]["posterior"]["hypotheses"], key=tree["axes"]["gx"]["posterior"]["hypotheses"].get)
    where = ("axes", "gx", "posterior", "parameters", law, "N")
    assert "must be a mapping, not 1" in refused(part, put(tree, where, 1), path)
    for key in ("median", "q05", "q95"):
        assert "must be a finite number above 0, not 1000" in refused(part, put(tree, (*where, key), 10**400), path)
    assert "duration_s: must be a finite number" in refused(part, put(tree, ("recording", "duration_s"), 10**400), path)
    read = [
        at
        for at in places(tree)
        if at[0] in ("schema", "recording", "model") or at[2:3] in ((), ("posterior",), ("unit",))
    ]
    chance = random.Random("diagnosis")
    taken = 0
    trials = case_records(300, 8000)
    for _ in range(trials):
        made = tree
        for _ in range(chance.choice((1, 1, 1, 2))):
            at = chance.choice(read)
            try:
                made = put(made, at, chance.choice(HOSTILE))
            except (KeyError, TypeError, IndexError):  # the first change has taken the place away
                continue
        taken += refused(part, made, path) == ""
    assert taken < trials / 2  # the changes are no harmless ones


def test_changed_bytes_of_a_diagnosis(part: Part, tmp_path: Path) -> None:
    """Bytes and pieces of the text changed."""
    data = part.diagnosis.read_bytes()
    path = tmp_path / "d.json"
    chance = random.Random("bytes")
    for _ in range(case_records(50, 1000)):
        made = bytearray(data)
        for _ in range(chance.choice((1, 1, 3))):
            at = chance.randrange(len(made))
            made[at : at + chance.choice((0, 1, 8))] = chance.choice(
                (b"", b"9" * 400, b"{", b"]", b'"', b"\0", b"\xff", b"e999", b"-", b"null", b"1")
            )
        path.write_bytes(made)
        try:
            load_start(path, part.model)
        except UserError as error:
            assert str(error).startswith(str(path)) and "\n" not in str(error)


# -------------------------------------------------------------------------------------------- names that hold lines

NAMES = [
    "a\ngyroscope_noise_density: 9\n# b", "a\r\nhypotheses: {constant: 1}\r\n#", "a\u2028bank_rate_hz: 7", "a\x85b: 1",
    "a --> <gyroscopeNoiseDensity>9</gyroscopeNoiseDensity> <!-- b", "a--b---c", "a */ int evil; /* b", 'a"; BO_ 1 b',
    "a\x1b[2Jb", "a\udc80b", "a\x00b", "a\\", "a\x0bparam set EKF2_GYR_NOISE 9\x0c", "$\\frac$ $x", "<b>&amp;",
    " ", "'", "`id`", "a\\", "*\\/",
]  # fmt: skip


def names(count: int) -> list[str]:
    """NAMES, and pieces of them put together."""
    chance = random.Random("names")
    pieces = [piece for name in NAMES for piece in re.findall(r"\W+|\w+", name)]
    return NAMES + ["".join(chance.choices(pieces, k=chance.randint(1, 8))) for _ in range(count)]


def content(form: str, text: str) -> Any:
    """What a program reads of an output: all but its comments."""
    if form == "rotors":
        return [(one.tag, one.text) for one in ET.fromstring(f"<all>{text}</all>")]
    if form == "px4":
        return [
            line.split("#")[0] for line in re.split(r"[\n\r\x0b\x0c\x1c-\x1e\x85\u2028\u2029]", text) if line[:1] != "#"
        ]
    if form == "c":
        return re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    if form == "dbc":
        return [
            (m.frame_id, m.name, [(s.name, s.start, s.unit) for s in m.signals])
            for m in cantools.database.load_string(text, "dbc").messages
        ]
    return yaml.safe_load(text.removeprefix("%YAML:1.0\n"))


def test_names_end_no_comment(part: Part, tmp_path: Path) -> None:
    """Of a recording, in each export and the model file; of a model and a diagnosis, in C; of a law, in a DBC file. A
    program reads the same as with a plain name."""
    tree = yaml.safe_load(Path(part.model.path).read_text())
    tables = make_tables(part.model, 1.0, ("gx",))

    def outputs(name: str) -> dict[str, str]:
        document = {**part.answer, "recording": {**part.answer["recording"], "path": f"/folder/{name}"}}
        made = {"model": model_text(tree, name, f"read-out of {name}")}
        for form in FORMS:
            write_export(document, form, tmp_path / form)
            made[form] = (tmp_path / form).read_text()
        write_tables(part.model, tables, tmp_path / "c", "host", f"gx from {name}, 600 s")
        made["c"] = (tmp_path / "c" / "selfcal_model.h").read_text()
        made["dbc"] = dbc_text(0, Names((name, "b"), (("N",), ("N",)), ((name, name),)), ("gx",))
        return made

    plain = {form: content(form, text) for form, text in outputs("plain").items() if form != "dbc"}
    for name in (one.replace("/", "|") for one in names(case_records(0, 600))):
        for form, text in outputs(name).items():
            assert form == "dbc" or content(form, text) == plain[form], (form, name)
            assert form != "dbc" or len(content(form, text)) > 8, name
            assert remark(name).isprintable()


def test_a_recording_with_a_line_feed_in_its_name(tmp_path: Path) -> None:
    """All outputs of two verbs: none stumbles, and the model is the one of the plain name."""
    models = []
    for name in ("plain.npz", "a\nbank_rate_hz: 7 # -->$\\frac$.npz", os.fsdecode(b"b\xff\xfe.npz")):
        log, rng = tmp_path / name, np.random.default_rng(3)
        save(log, {"gx": ("deg/s", 0.04 * rng.normal(size=400)), "ax": ("m/s^2", 5e-3 * rng.normal(size=400))}, 1.0, {})
        identify(log, json=tmp_path / "i.json", plot=tmp_path / "i.png", export=("kalibr", tmp_path / "k.yaml"))
        diagnose(
            log, axes=("gx",), json=tmp_path / "d.json", report=tmp_path / "d.html", write_model=tmp_path / "m.yaml"
        )
        model = yaml.safe_load((tmp_path / "m.yaml").read_text())
        model["sensor"].pop("name")  # the recording's
        models.append(model)
        assert set(yaml.safe_load((tmp_path / "k.yaml").read_text())) >= {"rostopic", "update_rate"}
        assert json.loads((tmp_path / "d.json").read_text())["recording"]["path"] == str(log)
    assert models[1] == models[0] == models[2]


# ---------------------------------------------------------------------------------------------------- a killed writer

KILLED = """
import os, signal, sys
import numpy as np
from selfcal.logs.recording import save
at, calls = int(sys.argv[2]), 0
def until(name):
    real = getattr(os, name)
    def call(*arguments, **options):
        global calls
        calls += 1
        if calls == at:
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*arguments, **options)
    return call
os.fsync = until("fsync")
save(sys.argv[1], {"gx": ("deg/s", np.full(50, 2.0))}, 1.0, {"seed": 2} if sys.argv[3] == "meta" else None)
"""


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".npz"] if case_records(0, 1) else [".csv"])
@pytest.mark.parametrize("old", [False, True])
def test_a_writer_killed_at_each_fsync(tmp_path: Path, suffix: str, old: bool) -> None:
    """A recording and the metadata beside it: both are the old ones or the new ones, or there are none."""
    log = tmp_path / f"log{suffix}"
    at = 1
    while True:
        for path in tmp_path.iterdir():
            path.unlink()
        if old:
            save(log, {"gx": ("deg/s", np.full(40, 1.0))}, 1.0, {"seed": 1})
        before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
        done = subprocess.run([sys.executable, "-c", KILLED, log, str(at), "meta"], check=False)
        after = {path.name: path.read_bytes() for path in tmp_path.iterdir() if not path.name.startswith(".selfcal-")}
        if done.returncode == 0:
            break
        assert done.returncode == -signal.SIGKILL
        assert after == before
        at += 1
    assert at == (2 if suffix == ".npz" else 3)
    recording = load(log)
    assert (recording.meta["seed"], recording.samples) == (2, 50)


def test_a_model_that_a_cortex_m0_has_no_room_for(tmp_path: Path) -> None:
    """Six axes with two regressors are refused in one line; three with small grids, which the linker takes, are not."""
    tree = yaml.safe_load(DEFAULT.read_text())
    columns = (("temperature", "temp", "degC"), ("supply", "supply", "V"))
    tree["regressors"] = [
        {"name": name, "kind": "column", "column": column, "unit": unit, "sd": {"gyro": 0.02, "accel": 0.02}}
        for name, column, unit in columns
    ]
    path = tmp_path / "model.yaml"
    path.write_text(yaml.safe_dump(tree, sort_keys=False))
    for target in ("cortex-m0", "cortex-m0-small"):
        with pytest.raises(UserError, match=r"^\S+model.yaml: 6 axes, 2 regressors, \d+ nodes take \d+\.\d KB of RAM"):
            codegen(path, tmp_path / "c", target=target)
        assert not (tmp_path / "c").exists()
    codegen(path, tmp_path / "c", target="cortex-m0-small", axes=("gx", "gy", "gz"))
    codegen(path, tmp_path / "d", target="cortex-m4f")


def test_the_room_is_counted_as_the_library_counts_it() -> None:
    """Truth: SELFCAL_SIZE of lib/README.md for six axes, 19.8 and 11 KB of 1024 bytes; 20 bytes a node and axis."""
    model = Model.load()
    sizes = [bank_bytes(make_tables(model, 1.0, None, target)) for target in ("cortex-m0", "cortex-m0-small")]
    assert [round(size / 1024.0, 1) for size in sizes] == [19.8, 11.0]


# --------------------------------------------------------------------------------------------------------------- set-up


@pytest.mark.parametrize(("browser", "root"), [("1", True), ("0", True), ("1", False)])
def test_set_up_names_the_browser_or_leaves_it_out(tmp_path: Path, browser: str, root: bool) -> None:
    """On a machine that has all but chromium; a stand-in for apt-get notes its calls."""
    (tmp_path / "apt-get").write_text(f'#!/bin/sh\necho "$@" >>"{tmp_path}/calls"\n')
    (tmp_path / "apt-get").chmod(0o755)
    machine = (
        'command() { [ "$2" != chromium ] && type "$2"; }; need() { :; }; '
        f"id() {{ echo {0 if root else 1000}; }}; "
        f"eval \"$(sed '/^need() /,/^}}/d' tools/setup/system.sh)\""
    )
    environment = {
        **os.environ,
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
        "PYTHON": sys.executable,
        "BROWSER": browser,
    }
    command = ["sh", "-c", machine, "system.sh", "dev"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    calls = (tmp_path / "calls").read_text() if (tmp_path / "calls").exists() else ""
    assert ("chromium" in calls) == ("chromium" in done.stdout) == (browser == "1" and root)
    assert ("BROWSER=0 leaves it out" in done.stdout) == (browser == "1" and root)
    assert ("No chromium" in done.stderr) == (browser == "1")
