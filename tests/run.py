"""Run every suite and close with one line that sums them: `N passed, N failed[, N skipped]`. Called by `make test`.

Each target of `make check` counts as one test; a program that dies without a summary counts as one failure.
`--quick` (`make quick`) runs the checks, the C tests and a thin way through everything.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import long_run

ROOT = Path(__file__).resolve().parent.parent
BUILD = ROOT / "build"
#: s; a suite that takes longer hangs.
TIMEOUT = {"check": 1800, "c": 600, "bench": 300, "fuzz": 300, "pytest": 3000}
#: s, by kernel
FUZZ_SECONDS = {"float": 12, "fixed": 8}
#: What the suites after the checks run.
BUILT = ("c-tests", "bench-images", "firmware-images", *(f"build/fuzz/{kernel}/fuzz_api" for kernel in FUZZ_SECONDS))
#: Tests that are named with their CPU time; build/seconds.txt has all.
LONGEST = 12
#: At once; the machine that this is to be quick on has two cores.
WORKERS = 2
#: Left out of `make quick`: the slowest of the checks.
SLOW_CHECKS = ("check-tidy", "check-c++")
#: Variants of the C tests; the first one is plain, and alone in `make quick`.
VARIANTS = ("plain", "sanitized", "fixed")
#: The thin way of `make quick`: numbers against the textbook, the command, the wire, a recording through the firmware,
#: both images on their boards. A test that is gone is an error.
QUICK = (
    "agree/test_bank.py::test_parity_with_the_textbook_bank[gauss_markov-1000-gaps]",
    "agree/test_reference.py::test_bank_over_time_follows_equations_11_to_14",
    "agree/test_report.py::test_report_over_the_whole_prior[100]",
    "tools/test_cli.py::test_version_is_the_headers",
    "tools/test_cli.py::test_identify_loads_no_scipy_optimize",
    "tools/test_units.py",
    "tools/test_export.py",
    "port/test_firmware_faults.py::test_saturation",
    "port/test_firmware_m0.py::test_samples_and_telemetry",
    "port/test_firmware_commands.py::test_an_answer_outlives_the_next_question",
)
C_TESTS = sorted(path for room in ("lib", "port") for path in (ROOT / "tests" / room).glob("test_*.c"))
MAKE = ("make", "--silent", "--keep-going", "--output-sync=target", f"--jobs={WORKERS}")


@dataclass
class Count:
    """Outcomes of a suite."""

    passed: int = 0
    failed: int = 0
    skipped: int = 0

    def __iadd__(self, other: Count) -> Count:
        self.passed += other.passed
        self.failed += other.failed
        self.skipped += other.skipped
        return self

    def __str__(self) -> str:
        skipped = f", {self.skipped} skipped" if self.skipped else ""
        return f"{self.passed} passed, {self.failed} failed{skipped}"


def run(command: list[str], timeout: int) -> tuple[int | None, str]:
    """Exit code (None: did not end in time) and output of a command run in the root folder."""
    try:
        done = subprocess.run(
            command,
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=timeout,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        return None, f"{(error.stdout or b'').decode(errors='replace')}\nno end after {timeout} s"
    return done.returncode, done.stdout.decode(errors="replace")


def checks(quick: bool) -> Count:
    """Every target of `make check`. With them, so that no core idles, what the later suites run is made; they tell
    what of that failed."""
    makefile = (ROOT / "tests" / "checks.mk").read_text(encoding="utf-8")
    match = re.search(r"^CHECKS := ((?:.*\\\n)*.*)$", makefile, re.MULTILINE)
    names = [
        name for name in (match[1].replace("\\\n", " ").split() if match else []) if not (quick and name in SLOW_CHECKS)
    ]
    built = [program(VARIANTS[0], source) for source in C_TESTS] if quick else BUILT
    code, output = run([*MAKE, *names, *map(str, built)], TIMEOUT["check"])
    made = r"\*\*\* \[[^\]]*: (check-\S+)\]|Target '(check-\S+)' not remade"
    failed = {a or b for a, b in re.findall(made, output)} if code in (0, 2) else set(names)
    for name in names:
        print(f"{'FAILED' if name in failed else 'ok    '} {name}")
    if failed:
        print(output)
    return Count(len(names) - len(failed), len(failed))


def program(variant: str, source: Path) -> Path:
    """The C test's program, from the root folder."""
    return Path("build", "c", variant, source.stem)


def c_tests(quick: bool) -> Count:
    """Unity programs, built plainly, with sanitizers, and these over the integer kernels."""
    targets = [str(program(VARIANTS[0], source)) for source in C_TESTS] if quick else ["c-tests"]
    code, output = run([*MAKE, *targets], TIMEOUT["c"])
    total = Count()
    if code != 0:
        print(f"FAILED c-tests do not build\n{output}")
        total.failed += 1
    sources = C_TESTS if quick else [*C_TESTS, *sorted((ROOT / "tests" / "lib" / "fixed").glob("test_*.c"))]
    made = [ROOT / program(variant, source) for variant in VARIANTS[: 1 if quick else None] for source in sources]
    with ThreadPoolExecutor(WORKERS) as pool:
        for count in pool.map(c_test, (path for path in made if path.is_file())):
            total += count
    return total


def c_test(path: Path) -> Count:
    """Runs one of them."""
    code, output = run([str(path)], TIMEOUT["c"])
    summary = re.search(r"^(\d+) Tests (\d+) Failures (\d+) Ignored", output, re.MULTILINE)
    if summary is None or code is None or code < 0 or (code != 0 and summary[2] == "0"):
        count = Count(failed=1)
    else:
        tests, failed, ignored = (int(number) for number in summary.groups())
        count = Count(tests - failed - ignored, failed, ignored)
    print(f"{'FAILED' if count.failed else 'ok    '} {path.relative_to(BUILD)}: {count}")
    if count.failed:
        print(output)
    return count


def bench(quick: bool) -> Count:
    """Instruction counts and sizes against the committed ones: exact, so one test."""
    code, output = run([*MAKE, "bench-counts"], TIMEOUT["bench"])
    skipped = code == 0 and "NOT COMPARED" in output
    count = Count(skipped=1) if skipped else Count(passed=1) if code == 0 else Count(failed=1)
    print(f"{'SKIPPED' if skipped else 'ok    ' if code == 0 else 'FAILED'} bench-counts")
    if not count.passed:
        print(output)
    return count


def fuzz(quick: bool) -> Count:
    """Random calls of the library for a while, after those that failed it once: one test a kernel."""
    total = Count()
    with ThreadPoolExecutor(WORKERS) as pool:
        for count in pool.map(fuzz_kernel, FUZZ_SECONDS):
            total += count
    return total


def fuzz_kernel(kernel: str) -> Count:
    """One of its builds."""
    arguments = (f"KERNEL={kernel}", f"SECONDS={FUZZ_SECONDS[kernel]}")
    code, output = run(["make", "--silent", "fuzz", *arguments], TIMEOUT["fuzz"])
    runs = re.search(r"number_of_executed_units: (\d+)", output)
    passed = code == 0 and runs is not None and int(runs[1]) > 0
    print(f"{'ok    ' if passed else 'FAILED'} fuzz {kernel}: {runs[1] if runs else 'no'} executions")
    if not passed:
        print(output)
    return Count(passed=1) if passed else Count(failed=1)


def pytest(quick: bool) -> Count:
    """The Python tests; their output is shown as it comes. A worker that is done takes tests from the other."""
    report, seconds = BUILD / "pytest.xml", BUILD / "seconds.txt"
    report.unlink(missing_ok=True)
    seconds.unlink(missing_ok=True)
    os.environ["SELFCAL_SECONDS"] = str(seconds)
    command = [sys.executable, "-m", "pytest", "-q", f"-n{WORKERS}", "--dist=worksteal"]
    chosen = [f"tests/{test}" for test in QUICK] if quick else ["tests"]
    try:
        code = subprocess.run(
            [*command, "--config-file=tools/pyproject.toml", "--rootdir=.", f"--junitxml={report}", *chosen],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            timeout=TIMEOUT["pytest"],
            check=False,
        ).returncode
    except subprocess.TimeoutExpired:
        print(f"FAILED pytest: no end after {TIMEOUT['pytest']} s")
        return Count(failed=1)
    if not report.is_file():
        print("FAILED pytest: no report")
        return Count(failed=1)
    longest(seconds)
    total = Count()
    for suite in ElementTree.parse(report).iter("testsuite"):
        tests, failed, errors, skipped = (int(suite.get(key, 0)) for key in ("tests", "failures", "errors", "skipped"))
        total += Count(max(0, tests - failed - errors - skipped), failed + errors, skipped)
    if code != 0 and total.failed == 0:
        total.failed = 1
    return total


def longest(seconds: Path) -> None:
    """Prints the tests that take most CPU time, and the sum of all (tests/conftest.py)."""
    lines = seconds.read_text(encoding="utf-8").splitlines() if seconds.exists() else []
    rows = sorted(((float(time), test) for time, _, test in (line.partition(" ") for line in lines)), reverse=True)
    print(f"{sum(time for time, _ in rows):.0f} CPU s in {len(rows)} tests; the longest:")
    for cpu_s, test in rows[:LONGEST]:
        print(f"{cpu_s:8.1f} {test}")


def main() -> None:
    """The suites, each timed; exit code 1 if anything failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="checks, C tests and a thin way through everything")
    quick = parser.parse_args().quick
    BUILD.mkdir(exist_ok=True)
    # The matrices of the tests are small: a BLAS with threads burns a core and is no faster.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    total = Count()
    for suite in (checks, c_tests, pytest) if quick else (checks, c_tests, fuzz, bench, pytest):
        start = time.monotonic()
        count = suite(quick)
        print(f"{suite.__name__}: {count} ({time.monotonic() - start:.0f} s)", flush=True)
        total += count
    print(f"not part of `make quick`: {', '.join(SLOW_CHECKS)}, the rest of `make test`" if quick else long_run.say())
    (BUILD / "summary").write_text(f"{total}\n")
    print(total, flush=True)
    sys.exit(total.failed > 0)


if __name__ == "__main__":
    main()
