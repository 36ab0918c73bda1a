"""`selfcal fleet`: a table of many recordings, from which nothing is lost and in which nothing is twice.

Truth: the files that a test writes, their parameters, and the bytes of an undisturbed run.
"""

from __future__ import annotations

import csv
import html
import importlib.util
import json
import math
import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from selfcal.base.errors import UserError
from selfcal.base.units import factor
from selfcal.batch.batch_files import BatchSource
from selfcal.batch.batch_summary import batch_keys, lines_of, summed_up
from selfcal.batch.fleet import document_with, judged_units
from selfcal.batch.fleet_page import fleet_html
from selfcal.batch.spread import DEATHS, Row, spread
from selfcal.batch.unit_table import COLUMNS, BatchUnit
from selfcal.batch.verdicts import Limits
from selfcal.logs.recording import save
from selfcal.model.file import Model
from selfcal.verbs.fleet import fleet

from conftest import COMMAND, case_records, run

AXES = ("gx", "gz")


def unit(path: Path, seed: int, *, seconds: int = 400, rate_hz: float = 4.0, N: float = 0.03, K: float = 2e-3) -> Path:
    """A recording of white noise and a walk on two axes."""
    random, n = np.random.default_rng(seed), int(seconds * rate_hz)
    walk = np.cumsum(random.standard_normal((2, n)), axis=1) * K / np.sqrt(rate_hz)
    values = walk + N * np.sqrt(rate_hz) * random.standard_normal((2, n))
    save(path, {name: ("deg/s", row) for name, row in zip(AXES, values, strict=True)}, rate_hz)
    return path


@pytest.fixture
def logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Five recordings in two folders, the working folder above them."""
    monkeypatch.chdir(tmp_path)
    for k in range(5):
        folder = tmp_path / "logs" / ("a" if k < 3 else "b")
        folder.mkdir(parents=True, exist_ok=True)
        unit(folder / f"sn{k:02}.npz", k)
    return tmp_path


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_a_row_for_each_unit_axis_and_parameter(logs: Path) -> None:
    result = fleet(["logs/**/*.npz"], "t.csv", workers=2)
    rows = table(logs / "t.csv")
    assert tuple(rows[0]) == COLUMNS
    assert result["code"] == 0 and result["devices"] == 5
    keys = [(row["device"], row["axis"], row["parameter"]) for row in rows]
    assert len(set(keys)) == len(keys)
    for device in (f"sn{k:02}" for k in range(5)):
        for axis in AXES:
            mine = {row["parameter"]: row for row in rows if (row["device"], row["axis"]) == (device, axis)}
            assert {"N", "bias"} < set(mine)
            # N of 1600 samples at 4 Hz, in means of 1 s: 400 of them leave 3.5 %; 4 sd
            assert float(mine["N"]["median"]) == pytest.approx(0.03, rel=0.15)
            assert mine["N"]["parameter_unit"] == "deg/s/sqrt(Hz)"
    fine = [row["adequate"] == "true" for row in rows if row["parameter"] == "N"]
    assert len(fine) == 10 and sum(fine) >= 8  # checks call one clean axis in 60 inadequate


def test_what_cannot_be_read_is_a_row(logs: Path) -> None:
    """Broken in each its own way: text, a cut archive, an empty file, an axis that is stuck."""
    (logs / "logs/text.csv").write_text("no header\n1,2\n")
    (logs / "logs/cut.npz").write_bytes((logs / "logs/a/sn00.npz").read_bytes()[:4000])
    (logs / "logs/empty.ulg").write_bytes(b"")
    random = np.random.default_rng(1).standard_normal(4000)
    columns = {"gx": ("deg/s", 0.1 * random), "gy": ("deg/s", np.full(4000, 400.0))}
    save(logs / "logs/stuck.npz", columns, 10.0)
    result = fleet(["logs/**/*.*"], "t.csv")
    rows = {(row["device"], row["axis"]): row for row in table(logs / "t.csv")}
    for device in ("text", "cut", "empty"):
        assert rows[device, ""]["error"] and not rows[device, ""]["median"]
        assert device in result["not_judged"]
    assert rows["stuck", "gy"]["error"] and not rows["stuck", "gx"]["error"]
    assert "stuck" in result["not_judged"]
    assert result["code"] == 2 and result["recordings"] == 9


def test_the_command_ends_by_its_code(logs: Path) -> None:
    """Names the devices without a result; Parquet has the same rows."""
    (logs / "logs/a/bad.csv").write_text("gx[deg/s]\nx\n")
    found = run("fleet", "logs/a/*", "-o", "t.csv", cwd=logs)
    assert found.returncode == 2 and "not judged: bad: " in found.stdout and "Traceback" not in found.stderr
    assert run("fleet", "logs/b/*", "-o", "t.csv", cwd=logs).returncode == 0
    assert run("fleet", "logs/b/*", "-o", "t.txt", cwd=logs).returncode == 2
    missing = run("fleet", "logs/c/*", "-o", "t.csv", cwd=logs)
    assert missing.returncode == 2 and "no recording matches 'logs/c/*'" in missing.stderr
    if importlib.util.find_spec("pyarrow") is not None:
        from pyarrow import parquet

        fleet(["logs/a/*"], "t.csv")
        fleet(["logs/a/*"], "t.parquet", results="t.csv.parts")
        kept = parquet.read_table(logs / "t.parquet").to_pylist()
        rows = table(logs / "t.csv")
        assert [row["device"] for row in kept] == [row["device"] for row in rows]
        assert list(kept[0]) == list(COLUMNS)
        for one, other in zip(kept, rows, strict=True):
            assert one["median"] is None if not other["median"] else f"{one['median']:.9g}" == other["median"]


def test_one_recording_under_two_names_counts_once(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Unless the table of units says that the names are of two devices: then the second has no recording."""
    shutil.copy("logs/a/sn01.npz", "logs/again.npz")
    (logs / "logs/link.npz").symlink_to(logs / "logs/a/sn01.npz")
    assert fleet(["logs/**/*.npz", "logs/a/sn01.npz"], "t.csv")["recordings"] == 5
    assert "logs/again.npz: the same recording as logs/a/sn01.npz: counted once" in capsys.readouterr().err
    (logs / "units.csv").write_text("file,device\nlogs/a/sn01.npz,A\nagain.npz,B\n")
    result = fleet(["logs/a/sn01.npz", "logs/again.npz"], "t.csv", units_table="units.csv")
    assert result["not_judged"] == {"B": ["is the same recording as logs/a/sn01.npz of device A"]}


def test_its_own_files_are_no_recordings(logs: Path) -> None:
    """A pattern may match the table, the kept recordings and the page of the run before. Names may be any bytes."""
    shutil.copy("logs/a/sn00.npz", os.fsdecode(b"logs/a/odd\xff\n.npz"))
    Path("logs/a/sn00.npz").unlink()
    for output in ("logs/t.csv", "logs/t.csv", "logs/t.parquet", "logs/t.csv"):
        if output.endswith(".csv") or importlib.util.find_spec("pyarrow") is not None:
            given = ["logs/**/*.npz"] if output.endswith("t.parquet") else ["logs/**/*"]
            result = fleet(given, output, report="logs/t.html", json="logs/t.json", results="logs/kept")
            assert result["recordings"] == 5 + (output == "logs/t.csv" and Path("logs/t.parquet").exists())
    with pytest.raises(UserError, match="is one of the recordings"):
        fleet(["logs/a/sn01.npz"], "logs/x.csv", json="logs/a/sn01.npz")


def test_whose_recording_it_is(logs: Path) -> None:
    (logs / "units.csv").write_text(
        "file,device,station,lot,date\nlogs/a/sn00.npz,X7,north,L1,2026-03-01\nsn03.npz,X8,south,L2,2026-03-02\n"
    )
    fleet(["logs/**/*.npz"], "t.csv", units_table="units.csv")
    rows = {row["recording"]: row for row in table(logs / "t.csv")}
    first = rows["logs/a/sn00.npz"]
    assert [first[key] for key in ("device", "station", "lot", "recorded_at")] == ["X7", "north", "L1", "2026-03-01"]
    assert rows["logs/b/sn03.npz"]["device"] == "X8" and rows["logs/a/sn01.npz"]["device"] == "sn01"
    fleet(["logs/**/*.npz"], "t.csv", serial_from=r"name:sn(\d+)")
    assert {row["device"] for row in table(logs / "t.csv")} == {"00", "01", "02", "03", "04"}
    values = 0.1 * np.random.default_rng(5).standard_normal(2000)
    save("logs/a/meta.npz", {"gx": ("deg/s", values)}, 5.0, {"serial": "Q-9", "date": "2026-05-05"})
    fleet(["logs/a/*.npz"], "t.csv", serial_from="field")
    found = {row["recording"]: row for row in table(logs / "t.csv")}
    assert found["logs/a/meta.npz"]["device"] == "Q-9" and found["logs/a/meta.npz"]["recorded_at"] == "2026-05-05"
    shutil.copy("logs/a/sn00.npz", "logs/b/sn01.npz")  # another unit's, by the name of one that is there
    fleet(["logs/**/sn0[13].npz"], "t.csv")
    assert {row["device"] for row in table(logs / "t.csv")} == {"logs/a/sn01.npz", "logs/b/sn01.npz", "sn03"}
    for text, words in (
        ("file,station\n", "its first line must name each of"),
        ("file,device\nsn00.npz\n", "line 2: 1 fields where the first line has 2"),
        ("file,device\nlogs/a/sn00.npz,A\nsn00.npz,B\n", "line 3: 'sn00.npz' is there twice"),
    ):
        (logs / "units.csv").write_text(text)
        with pytest.raises(UserError, match=words):
            fleet(["logs/a/*.npz"], "t.csv", units_table="units.csv")


def test_what_a_pattern_or_a_table_has_beside_recordings_is_a_line(
    logs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A shell's pattern names folders and links to nothing; a table rows and columns of another use."""
    (logs / "logs/gone.npz").symlink_to(logs / "nowhere.npz")
    (logs / "units.csv").write_text("file,device,Shift\nsn03.npz,X,2\nsn77.npz,Y,1\n")
    given = ["logs/gone.npz", "logs/a", "logs/b/sn03.npz", "logs/b/sn04.npz"]
    assert fleet(given, "t.csv", units_table="units.csv")["recordings"] == 2
    said = capsys.readouterr().err
    assert "logs/gone.npz: is a link to nothing: skipped" in said and "logs/a: is a folder" in said
    assert "no recording of the batch is 'sn77.npz' (line 3)\n" in said and "does not read Shift (known: " in said
    assert fleet(["logs/**/*.npz"], "t.csv")["recordings"] == 5
    said = capsys.readouterr().err
    assert "logs/gone.npz: is a link" in said and "folder" not in said
    for none in (["logs/gone.npz"], ["logs/a"], ["logs/b/sn03.npz", "logs/b/sn33.npz"]):
        with pytest.raises(UserError, match=f"no recording matches '{none[-1]}'"):
            fleet(none, "t.csv")


def test_dates_are_iso_8601(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Others are refused in a table of units, and left out with a line in metadata. Zones count in the order."""
    for date in ("03/11/2025", "yesterday", "2025-02-30", "2025-3-1", "2025-03-01Tnoon", "20250301"):
        (logs / "units.csv").write_text(f"file,device,date\nsn00.npz,A,2025-01-31\nsn01.npz,A,{date}\n")
        with pytest.raises(UserError, match=f"units.csv: line 3: date '{date}': write it as 2026-03-01 or "):
            fleet(["logs/a/*.npz"], "t.csv", units_table="units.csv")
    dates = ("2025-11-03T01:30:00+02:00", "2025-11-03", "2025-11-02 23:45:00Z")  # the first is at 23:30 of the 2nd
    lines = [f"sn0{k}.npz,A,{date}" for k, date in enumerate(dates)]
    (logs / "units.csv").write_text("\n".join(["file,device,date", *lines]))
    fleet(["logs/a/*.npz"], "t.csv", units_table="units.csv")
    order = list(dict.fromkeys(row["recorded_at"] for row in table(logs / "t.csv")))
    assert order == [dates[0], dates[2], dates[1]]
    values = 0.1 * np.random.default_rng(6).standard_normal(2000)
    save("logs/b/meta.npz", {"gx": ("deg/s", values)}, 5.0, {"date": "5. May 2025"})
    fleet(["logs/b/meta.npz"], "t.csv")
    assert "logs/b/meta.npz: leaves out the date '5. May 2025': write it as 2026-03-01" in capsys.readouterr().err
    assert {row["recorded_at"] for row in table(logs / "t.csv")} == {""}


def test_limits_read_as_data_sheets_print(tmp_path: Path) -> None:
    """With or without a blank, with the signs of print; a minimum above its maximum is refused across units."""
    place = tmp_path / "limits.yaml"
    for text in ("0.9 °/s/√Hz", "0.9°/s/√Hz", "54deg/sqrt(h)", "5.4e1 °/√h"):  # 1 deg/sqrt(h) is 1/60 deg/s/sqrt(Hz)
        place.write_text(f"gz.N: {{max: '{text}'}}\n")
        (limit,) = Limits.load(place, Model.load()).stated
        assert limit.value * factor(limit.unit, "deg/s/sqrt(Hz)") == pytest.approx(0.9, rel=1e-12)
    for text in (
        "gz.bias: {min: 0.3 deg/s, max: 900 deg/h}",
        "gyro.N: {min: 3 deg/s/sqrt(Hz)}\ngz.N: {max: 2 deg/s/sqrt(Hz)}",
    ):
        place.write_text(text)
        with pytest.raises(UserError, match=r"limits.yaml: gz\.(bias|N): min .* is above max "):
            Limits.load(place, Model.load())
    place.write_text("gz.bias: {min: 0.3 deg/s, max: 1500 deg/h}")
    assert len(Limits.load(place, Model.load()).stated) == 2


def test_finished_recordings_are_kept(logs: Path) -> None:
    """A changed file alone is done anew; one that failed is looked at again; other settings are another work."""
    (logs / "logs/a/bad.csv").write_text("gx[deg/s]\nx\n")
    fleet(["logs/**/*.*"], "t.csv")
    first = (logs / "t.csv").read_bytes()
    parts = logs / "t.csv.parts"
    stamps = {path: path.stat().st_mtime_ns for path in parts.iterdir()}
    assert len(stamps) == 5
    fleet(["logs/**/*.*"], "t.csv")
    assert (logs / "t.csv").read_bytes() == first
    assert {path: path.stat().st_mtime_ns for path in parts.iterdir()} == stamps
    unit(logs / "logs/a/sn02.npz", 77)
    unit(logs / "logs/a/bad.csv", 78)
    assert fleet(["logs/**/*.*"], "t.csv")["code"] == 0
    assert len(list(parts.iterdir())) == 7 and (logs / "t.csv").read_bytes() != first
    fleet(["logs/**/*.*"], "t.csv", axes=["gz"])
    assert len(list(parts.iterdir())) == 13
    assert {row["axis"] for row in table(logs / "t.csv")} == {"gz"}
    next(iter(parts.iterdir())).write_text("{")  # cut
    fleet(["logs/**/*.*"], "t.csv", axes=["gz"])


def children(pid: int) -> list[int]:
    """The processes that a process started."""
    try:
        tasks = Path(f"/proc/{pid}/task").iterdir()
        return [int(number) for task in tasks for number in (task / "children").read_text().split()]
    except OSError:
        return []


def resident_mb(pid: int) -> float:
    """Memory of a process in MB; NaN when it has gone."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:
        return math.nan


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="NO /proc")
def test_killed_workers_and_a_killed_run_lose_nothing(tmp_path: Path) -> None:
    """Three workers are killed by their ids on the way, then the command itself: the end has the bytes of an
    undisturbed run. Of many recordings, no process of that run grows: workers by 5 MB, the command by 30 kB a
    recording, which is the row that it keeps (13 kB of two axes; 2 times for an allocator's steps)."""
    many = case_records(12, 1000)
    (tmp_path / "logs").mkdir()
    for k in range(many):
        unit(
            tmp_path / f"logs/u{k:04}.npz",
            k,
            **({"seconds": 4000, "rate_hz": 10.0} if many == 12 else {"seconds": 1200, "rate_hz": 1.0}),
        )
    done = tmp_path / "whole.csv.parts"

    def finished(folder: Path) -> int:
        return len(list(folder.glob("*.json")))

    def started(output: str) -> subprocess.Popen[bytes]:
        command = [*COMMAND, "fleet", "logs/*", "-o", output, "--workers", "2"]
        return subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    began, memory = time.monotonic(), list[tuple[int, float, float]]()
    whole = started("whole.csv")
    while whole.poll() is None:
        workers = [resident_mb(pid) for pid in children(whole.pid)]
        if len(workers) == 2:
            memory.append((finished(done), resident_mb(whole.pid), max(workers)))
        time.sleep(0.1)
    assert whole.returncode == 0
    print(f"{60.0 * many / (time.monotonic() - began):.0f} recordings a minute")
    if many > 100:
        early, *_, late = (one for one in memory if 0.1 * many < one[0] < many and not math.isnan(one[1] + one[2]))
        print(f"finished, MB of the command, MB of a worker: {early}, {late}")
        assert late[1] - early[1] < 0.03 * (late[0] - early[0]) and late[2] - early[2] < 5.0

    running = started("t.csv")
    killed: set[int] = set()
    while running.poll() is None:
        count = finished(tmp_path / "t.csv.parts")
        if len(killed) < 3 and count >= len(killed) * many // 6:
            for worker in list(set(children(running.pid)) - killed)[:1]:
                os.kill(worker, signal.SIGKILL)
                killed.add(worker)
        elif len(killed) == 3 and count >= many // 2:
            running.kill()
        time.sleep(0.02)
    assert len(killed) == 3 and running.returncode == -signal.SIGKILL
    assert not (tmp_path / "t.csv").exists() and finished(tmp_path / "t.csv.parts") < many
    assert started("t.csv").wait() == 0
    assert (tmp_path / "t.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()


def deadly(log: Path, job: int) -> list[Row]:
    """Job 3 kills whoever does it."""
    if job == 3:
        with log.open("a") as stream:
            stream.write("x")
        os.kill(os.getpid(), signal.SIGKILL)
    return [{"job": job}]


def test_what_kills_its_worker_is_a_row(tmp_path: Path) -> None:
    from functools import partial

    log = tmp_path / "log"
    rows = spread(partial(deadly, log), range(8), count=2, lost=lambda job: [{"lost": job}])
    assert rows == [{"lost": job} if job == 3 else {"job": job} for job in range(8)]
    assert len(log.read_text()) == DEATHS


def test_causes_and_their_exit_code(logs: Path) -> None:
    """A step of 20 sd on one axis of one unit; the others have none."""
    with np.load(logs / "logs/a/sn01.npz") as archive:
        values = np.array(archive["gx[deg/s]"])
        other = np.array(archive["gz[deg/s]"])
    values[900:] += 1.0
    save(logs / "logs/a/sn01.npz", {"gx": ("deg/s", values), "gz": ("deg/s", other)}, 4.0)
    result = fleet(["logs/a/sn0[12].npz"], "t.csv", diagnose=True, fail_on="step", report="logs/t.html")
    assert result["failed"] == {"sn01": ["step: gx"]} and result["code"] == 1
    causes = {(row["device"], row["axis"]): row["causes"] for row in table(logs / "t.csv")}
    assert causes.pop(("sn01", "gx")) == "step"
    material = {(row["device"], row["axis"]) for row in table(logs / "t.csv") if row["material"] == "step"}
    assert material == {("sn01", "gx")}
    assert "step" not in " ".join(causes.values())
    (link,) = re.findall(r"<b>sn01</b>.*?<a href='([^']+)'", (logs / "logs/t.html").read_text())
    page_of_unit = logs / "logs" / link
    made = page_of_unit.stat().st_mtime_ns
    assert "step" in page_of_unit.read_text() and len(list(page_of_unit.parent.iterdir())) == 1
    fleet(["logs/a/sn0[12].npz"], "t.csv", diagnose=True, fail_on="step", report="logs/t.html")
    assert page_of_unit.stat().st_mtime_ns == made  # the same recording by the same options
    with pytest.raises(UserError, match="--fail-on step: give --diagnose too"):
        fleet(["logs/a/*.npz"], "t.csv", fail_on="step")


def test_a_number_of_workers_changes_nothing(logs: Path) -> None:
    fleet(["logs/b/*.npz"], "one.csv", workers=1)
    fleet(["logs/b/*.npz"], "three.csv", workers=3)
    assert (logs / "one.csv").read_bytes() == (logs / "three.csv").read_bytes()
    kept = next(iter((logs / "one.csv.parts").glob("*.json")))
    assert set(json.loads(kept.read_text())[0]) == {"recording", "axes"}


@pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="DASK ABSENT: make setup-cluster")
def test_a_scheduler_that_is_killed_loses_nothing(tmp_path: Path) -> None:
    """By a cluster the bytes are those of this machine. The scheduler is killed on the way, the command says so in a
    line, and with another scheduler it goes on."""
    from test_spread import cluster

    if not case_records(0, 1):
        pytest.skip("SLOW: make cases")
    (tmp_path / "logs").mkdir()
    for k in range(16):
        unit(tmp_path / f"logs/u{k}.npz", k, seconds=4000, rate_hz=10.0)
    subprocess.run([*COMMAND, "fleet", "logs/*", "-o", "here.csv"], cwd=tmp_path, check=True, capture_output=True)
    kept = tmp_path / "t.csv.parts"
    with cluster() as (address, processes):
        command = [*COMMAND, "fleet", "logs/*", "-o", "t.csv", "--scheduler", address]
        running = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        while running.poll() is None and len(list(kept.glob("*.json"))) < 3:
            time.sleep(0.02)
        processes[0].kill()
        said = running.communicate(timeout=120)[1]
    assert running.returncode == 2 and "the Dask scheduler has gone" in said and "Traceback" not in said
    assert 3 <= len(list(kept.glob("*.json"))) < 16
    with cluster() as (address, _):
        command[-1] = address
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, timeout=120)
    assert (tmp_path / "t.csv").read_bytes() == (tmp_path / "here.csv").read_bytes()


def synthetic(units: int, seed: int = 1) -> list[BatchUnit]:
    """Recordings of three axes as `fleet` keeps them, of four stations, 50 a day; one in 100 odd, one in 200 broken."""
    random = np.random.default_rng(seed)
    found = []
    for k in range(units):
        source = BatchSource(
            f"logs/u{k:05}.npz",
            device=f"d{k:05}",
            station=f"s{k % 4}",
            recorded_at=str(np.datetime64("2026-01-05") + k // 50),
        )
        axes: dict[str, Any] = {}
        for axis in ("gx", "gy", "gz"):
            N = 0.02 * math.exp(0.05 * random.standard_normal())
            K = 1e-3 * math.exp(0.15 * random.standard_normal() + (1.5 if k % 100 == 7 else 0.0))
            estimates = {
                name: {
                    "median": value,
                    "q05": value * 0.9,
                    "q95": value * 1.1,
                    "unit": units_of,
                    "identified": True,
                    "off_grid": False,
                }
                for name, value, units_of in (("N", N, "deg/s/sqrt(Hz)"), ("K", K, "deg/s^2/sqrt(Hz)"))
            }
            axes[axis] = {
                "hypotheses": {"random_walk": 1.0},
                "log_evidence": {"random_walk": 0.0},
                "parameters": {"random_walk": estimates},
                "bias_now": {"mean": 0.3 * random.standard_normal(), "sd": 0.01, "unit": "deg/s"},
                "adequate": True,
                "marks": ["saturation"] if k % 300 == 5 else [],
            }
        record = {"error": "broken <b>"} if k % 200 == 3 else {"recording": {"duration_s": 3600.0}, "axes": axes}
        found.append(BatchUnit(source, record))
    return found


def test_an_axis_of_another_kind_is_left_out_with_a_line() -> None:
    """No factor turns an acceleration into an angular rate: the population has the other units."""
    batch = synthetic(12, 5)
    axis = batch[8].record["axes"]["gy"]
    axis["bias_now"] = {**axis["bias_now"], "unit": "m/s^2"}
    summary = summed_up(batch, Model.load())
    (line,) = [line for line in lines_of(summary) if line.startswith("left out")]
    assert line == "left out of the population: gy of d00008: reads in m/s^2, the model in deg/s"
    units = {name: one["units"] for name, one in batch_keys(summary)["population"].items()}
    assert units["gx.N"] - units["gy.N"] == 1 == units["gx.bias"] - units["gy.bias"]


def test_n_of_a_unit_without_numbers_of_the_batchs_law_is_compared() -> None:
    """A posterior of the batch's law that underflows has no number: the unit's N is that of its own law, three times
    the batch's. Its bias, ordinary, counts in the population."""
    batch = synthetic(14, 9)
    axis = batch[9].record["axes"]["gx"]
    walk = axis["parameters"]["random_walk"]
    own = {key: 3.0 * walk["N"][key] if key in ("median", "q05", "q95") else walk["N"][key] for key in walk["N"]}
    none = {name: {**one, "median": None, "q05": None, "q95": None} for name, one in walk.items()}
    axis["parameters"] = {"constant": {"N": own}, "random_walk": none}
    axis |= {
        "hypotheses": {"constant": 1.0, "random_walk": 0.0},
        "log_evidence": {"constant": 0.0, "random_walk": -3.0},
    }
    summary = summed_up(batch, Model.load())
    words = summary.unlike["d00009"]
    assert len(words) == 1 and words[0].startswith("gx.N ")
    population = batch_keys(summary)["population"]
    assert population["gx.N"]["left_out"] == ["d00009"] and population["gx.bias"]["left_out"] == []
    assert population["gx.K"]["units"] == population["gx.N"]["units"] - 1


def test_two_units_of_a_dozen_are_odd_by_their_marks() -> None:
    """Two of twelve that clip, or are of another law, are named; eight that clip are the batch's own."""
    for clipped in (2, 8):
        batch = synthetic(12, 10)
        for k, one in enumerate(unit for unit in batch if unit.error is None):
            axis = one.record["axes"]["gy"]
            axis["marks"] = ["saturation"] if k < clipped else []
            if k in (5, 6):
                axis["log_evidence"] = {"random_walk": -40.0, "constant": 0.0}
        named = [name for name, words in summed_up(batch, Model.load()).unlike.items() if "gy saturation" in words]
        laws = [
            words for words in summed_up(batch, Model.load()).unlike.values() if any("nats" in one for one in words)
        ]
        assert len(named) == (2 if clipped == 2 else 0) and len(laws) == 2


def test_a_quantity_that_few_units_identify_is_a_line() -> None:
    """No unit is judged by it, in whichever axis: the lines and the page state that, and how many identify it."""
    batch = synthetic(10, 6)
    for k, one in enumerate(batch):
        if one.error is None and k > 2:
            estimates = one.record["axes"]["gz"]["parameters"]["random_walk"]
            estimates["N"] = {**estimates["N"], "identified": False}
    summary = summed_up(batch, Model.load())
    document = batch_keys(summary)
    assert document["unidentified"] == {"gz.N": {"identified": 3, "units": 9}}
    assert "gz.N" not in document["population"] and "gz.K" in document["population"]
    (line,) = [line for line in lines_of(summary) if line.startswith("no population of gz.N: 3 of 9 units identify it")]
    assert line in fleet_html({**document_with(batch, None, []), **document}, summary, {})


def test_the_page_stays_small(tmp_path: Path) -> None:
    """Of 10 000 units it has less than 1 MB, no script, no address, and the odd units."""
    batch = synthetic(case_records(2000, 10000))
    limits = tmp_path / "limits.yaml"
    limits.write_text("gyro.N: {max: 0.021 deg/s/sqrt(Hz)}\n")
    judged = judged_units(batch, Limits.load(limits, Model.load()))
    summary = summed_up(batch, Model.load())
    document = {**document_with(batch, None, judged), **batch_keys(summary)}
    text = fleet_html(document, summary, {})
    assert len(text.encode()) < 1_000_000
    assert "<script" not in text and "http://" not in text and "https://" not in text
    assert "broken &lt;b&gt;" in text and "<b>d00107</b>: gx.K " in text
    assert text.count("<svg viewBox") > 9 and "data sheet's limit" in html.unescape(text)
    assert set(summary.unlike) >= {f"d{k:05}" for k in range(7, len(batch), 100) if k % 200 != 3}
    out = os.environ.get("SELFCAL_PAGE")
    if out:
        Path(out).write_text(text)


def test_the_page_of_a_real_batch(logs: Path) -> None:
    (logs / "logs/a/bad.csv").write_text("gx[deg/s]\nx\n")
    fleet(["logs/**/*.*"], "t.csv", report="fleet.html")
    text = (logs / "fleet.html").read_text()
    assert "<h1>6 recordings of 6 devices</h1>" in text and "Not judged" in text and "gx.N" in text
