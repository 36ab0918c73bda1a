"""What the library costs: exact instructions on emulated Cortex-M, bytes, and on request ns on this machine.

Compares with counts.json beside this file: growth above 2 % fails. Run by `make bench`, which builds the images first.
Counts of another compiler than that of counts.json are not compared; a line `NOT COMPARED` says so.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TypedDict

import image_sizes

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "bench"
REFERENCE = Path(__file__).with_name("counts.json")
DOCUMENT, PAGE = ROOT / "tests" / "COST.md", ROOT / "lib" / "README.md"
#: Where a document has its table. The lines of the long one are as long as its others.
LINE = 120
TABLE = re.compile(r"(<!-- python tests/bench/bench.py --\w+ -->\n).*?(\n<!-- end of the table -->)", re.DOTALL)
GROWTH = Fraction(2, 100)
#: s; an image that takes longer hangs.
TIMEOUT = 120
#: Instructions of the SysTick handler in image.c, and of the known loop's turns.
HANDLER, TURN = 5, 3
#: `-icount shift=6`: an instruction takes 2^6 ns.
SECONDS_PER_INSTRUCTION = Fraction(2**6, 10**9)
#: The default model's samples; axes of the images.
RATE_HZ, AXES = Fraction(8192, 10), 6
#: sigma_v nodes of the paper's grid.
SIGMAS = 12
#: Filters of the paper's recursion and of the library may give weights that differ by this part of the heaviest: with
#: P0 = (10 deg/s)^2 the first plain float update p_00 - k h leaves a rounding error of 2^-24 P0, 0.4 % of sigma_v^2.
WEIGHT_TOLERANCE = 4e-3


class Figures(TypedDict):
    """Of one target. `counts`: [instructions, units of work]; `sizes`: bytes; `facts`: what they go with."""

    counts: dict[str, list[int]]
    sizes: dict[str, int]
    facts: dict[str, int]


class Bench(TypedDict):
    """All that is exact."""

    compiler: str
    targets: dict[str, Figures]


@dataclass(frozen=True)
class Machine:
    """What QEMU emulates for a target."""

    board: str
    options: tuple[str, ...]
    systick_hz: int
    image: str  # the firmware that is built for it; empty: none
    report_s: int  # its default time between reports, BOARD_REPORT_MS


def _board(core: str, *, image: bool = True) -> tuple[int, str, int]:
    """Clock, image and time between reports of the first board with a core."""
    name, (_, clock_hz, report_s) = next(item for item in image_sizes.BOARDS.items() if item[1][0] == core)
    return clock_hz, name if image else "", report_s


MACHINES = {
    "cortex-m4f": Machine("netduinoplus2", (), *_board("cortex-m4f")),
    # The nRF51822 with 32 KB of RAM, since the bank and a report of six axes do not fit the 16 KB of the board's own.
    "cortex-m0": Machine("microbit", ("-global", "nrf51-soc.sram-size=0xC000"), *_board("cortex-m0")),
}

#: Files by the beginnings of their names: what a bank that reports and sends cannot be without.
ALWAYS = ("intake", "bank", "report", "telemetry")
#: ... but for what a model has to name.
NAMED = ("bank_columns", "bank_forget", "bank_states")
#: What a product with a pipe places, by the names that module.c prints.
PLACED = {
    "imu": "`selfcal_imu_t`",
    "kept": "`selfcal_kept_t`",
    "memory": "memory of `SELFCAL_MODEL_IMU_BYTES`",
}
#: Calls whose stack the image of the firmware shows.
CALLS = ("selfcal_imu_sample", "selfcal_imu_work", "selfcal_imu_save", "selfcal_imu_restore")


class BenchError(Exception):
    """What went wrong, in one line."""


def run(command: list[str]) -> str:
    """Output of a command, standard error included. Raises BenchError if it fails or hangs."""
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=TIMEOUT,
            text=True,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BenchError(f"{command[0]}: {error}") from error
    if done.returncode != 0:
        raise BenchError(f"{' '.join(command)}: exit code {done.returncode}\n{done.stdout}")
    return done.stdout


# ------------------------------------------------------------------------------------------------------------ measuring


def run_image(target: str, image: str) -> tuple[dict[str, list[int]], dict[str, int]]:
    """Counts and values that an image of a target prints."""
    machine = MACHINES[target]
    output = run(
        [
            *("qemu-system-arm", "-M", machine.board, *machine.options, "-display", "none", "-monitor", "none"),
            *("-serial", "none", "-icount", "shift=6,sleep=off", "-semihosting-config", "enable=on,target=native"),
            *("-kernel", str(BUILD / target / f"{image}.elf")),
        ]
    )
    values = {name: int(number) for name, number in re.findall(r"^value (\S+) (\d+)$", output, re.MULTILINE)}
    raw = {
        name: [int(number) for number in numbers.split()]
        for name, numbers in re.findall(r"^count (\S+) ([\d ]+)$", output, re.MULTILINE)
    }
    ticks_per_instruction = machine.systick_hz * SECONDS_PER_INSTRUCTION
    empty = raw.pop("clock.empty")[0]

    def instructions(ticks: int, parts: int, rounds: int) -> int:
        return round((ticks - parts * empty) / ticks_per_instruction) - HANDLER * rounds

    if "clock.loop_1000" in raw:
        short, long = (instructions(*raw.pop(f"clock.loop_{turns}")[:3]) for turns in (1000, 2001000))
        if abs(long - short - TURN * 2_000_000) > 1:  # one for the rounding of either
            raise BenchError(f"{target}: SysTick does not count instructions: {long - short} for {TURN * 2_000_000}")
    return {name: [instructions(*numbers[:3]), numbers[3]] for name, numbers in raw.items()}, values


def text_sizes(target: str) -> dict[str, int]:
    """Bytes of flash (code and constants): the library's objects, what the linker kept of them and drew in."""
    library = sorted(path.stem for path in (ROOT / "lib").glob("*.c"))
    objects = [str(BUILD / target / "objects" / f"{name}.o") for name in library]
    sizes = {}
    for line in run(["arm-none-eabi-size", *objects]).splitlines()[1:]:
        text, *_, path = line.split()
        sizes[f"text.{Path(path).stem}"] = int(text)
    sizes["text.library"] = sum(sizes.values())
    kept = {"library": 0, "always": 0, "tables": 0, "runtime": 0}
    linked = (BUILD / target / "image.map").read_text().partition("Linker script and memory map")[2]
    section = re.compile(r"^ \.(?:text|rodata)\S*\s+0x[0-9a-f]+\s+0x([0-9a-f]+)\s+(\S.*)$", re.MULTILINE)
    for size, path in section.findall(linked):
        if Path(path).stem in library:
            kept["library"] += int(size, 16)
            always = Path(path).stem.startswith(ALWAYS) and Path(path).stem not in NAMED
            kept["always"] += int(size, 16) if always else 0
        elif Path(path).stem == "selfcal_model":
            kept["tables"] += int(size, 16)
        elif ".a(" in path:
            kept["runtime"] += int(size, 16)
    return sizes | {f"linked.{room}": size for room, size in kept.items()}


def measure(target: str) -> Figures:
    """All exact figures of a target. Raises BenchError."""
    counts, values = run_image(target, "image")
    module_counts, module_values = run_image(target, "module")
    counts |= module_counts
    values |= module_values
    sizes = {name: value for name, value in values.items() if name.startswith(("ram.", "place."))}
    facts = {name: value for name, value in values.items() if name not in sizes}
    if "paper" in counts:
        difference, heaviest = facts["paper.worst_weight_difference_1e9"], facts["paper.heaviest_weight_1e9"]
        if difference > WEIGHT_TOLERANCE * heaviest:
            raise BenchError(
                f"{target}: posterior weights of the library and of the paper's recursion differ by {difference}e-9, "
                f"more than {WEIGHT_TOLERANCE:g} of the heaviest, {heaviest}e-9"
            )
    if MACHINES[target].image:
        counts |= measure_more(target)
        try:
            image, _ = image_sizes.measure(MACHINES[target].image)
            image |= image_sizes.stacks(MACHINES[target].image, CALLS)
        except image_sizes.FirmwareError as error:
            raise BenchError(f"{MACHINES[target].image}: {error}") from error
        sizes |= {f"firmware.{kind}": size for kind, size in image.items()}
    return {"counts": counts, "sizes": text_sizes(target) | sizes, "facts": facts}


def measure_more(target: str) -> dict[str, list[int]]:
    """Regressors and sums (more.c). Raises BenchError if a model without regressors pays for their code."""
    plain, regressors, sums = (run_image(target, image)[0] for image in ("plain", "regressors", "sums"))
    before, after = plain["without"][0], regressors.pop("without")[0]
    if abs(after - before) > 1:  # the rounding of the clock
        raise BenchError(f"{target}: {before} instructions without regressors, {after} with their code linked")
    found = {f"regressors.{name}": count for name, count in regressors.items()}
    return plain | found | {f"sums.{name}": count for name, count in sums.items()}


def measure_host() -> dict[str, dict[str, float]]:
    """ns per (node, sample, axis) of the library and of one textbook filter, by compiler flags."""
    found = {}
    for variant in ("O2", "O3-avx2"):
        if variant == "O3-avx2" and not {"avx2", "fma"} <= set(Path("/proc/cpuinfo").read_text().split()):
            continue
        lines = run([str(BUILD / "host" / variant / "bench")]).splitlines()
        found[variant] = {name: float(ns) for name, ns in (line.split() for line in lines)}
    return found


# ------------------------------------------------------------------------------------------------------------ comparing


def costs(figures: Figures) -> dict[str, Fraction]:
    """What may not grow: instructions per unit of work, bytes. The baseline is not the library's."""
    counts = {name: Fraction(count, per) for name, (count, per) in figures["counts"].items() if name != "paper"}
    return counts | {name: Fraction(size) for name, size in figures["sizes"].items()}


def compare(now: Bench, before: Bench) -> list[str]:
    """Complaints: what grew by more than GROWTH, is new or gone. Prints what shrank by as much."""
    complaints = []
    for target in MACHINES:
        old = costs(before["targets"][target]) if target in before["targets"] else {}
        new = costs(now["targets"][target])
        for name in sorted(old.keys() | new.keys()):
            if name not in old or name not in new:
                complaints.append(f"{'new' if name in new else 'gone'}: {target} {name}")
                continue
            if old[name] == 0:  # a file without code in this build
                if new[name] > 0:
                    complaints.append(f"grew: {target} {name}: from nothing to {float(new[name]):.6g}")
                continue
            change = new[name] / old[name] - 1
            line = f"{target} {name}: {float(old[name]):.6g} -> {float(new[name]):.6g} ({float(change):+.1%})"
            if change > GROWTH:
                complaints.append(f"grew: {line}")
            elif change < -GROWTH:
                print(f"shrank: {line}")
    return complaints


# ------------------------------------------------------------------------------------------------------------- printing


def table(bench: Bench) -> str:
    """The figures as a markdown table."""
    targets = bench["targets"]
    rows: list[tuple[str, list[str]]] = []

    def row(title: str, cells: dict[str, str]) -> None:
        rows.append((title, [cells.get(target, "") for target in targets]))

    def per(title: str, name: str, form: str = ",.0f") -> None:
        counts = {target: figures["counts"].get(name) for target, figures in targets.items()}
        row(title, {target: format(count[0] / count[1], form) for target, count in counts.items() if count})

    def number(title: str, kind: str, name: str) -> None:
        rows_of = {t: f["sizes"] if kind == "sizes" else f["facts"] for t, f in targets.items()}
        cells = {target: f"{of[name]:,}" for target, of in rows_of.items() if name in of}
        if cells:  # a file that is younger than counts.json has none
            row(title, cells)

    row("**instructions**", {})
    number("filters (nodes) of the default model", "facts", "nodes")
    per("`selfcal_push()`, six axes, averaging only", "push", ".1f")
    per("bank, every filter settled, per (node, sample, axis)", "bank.steady", ".2f")
    per("… without the intake", "bank.steady.alone", ".2f")
    per("bank, every filter but one varying, per (node, sample, axis)", "bank.varying", ".2f")
    per("bank, first 3600 samples, per (node, sample, axis)", "bank.hour", ".2f")
    number("filters settled after them", "facts", "bank.hour.settled")
    per("… all settled, regressors' code linked and not used", "without", ".2f")
    per("… and with `SELFCAL_TERMS_MAX` of 3", "sums.without", ".2f")
    for columns in (0, 1, 3, 6):
        title = f"random walk alone, {columns or 'no'} regressor{'s' if columns != 1 else ''}, per (node, sample, axis)"
        per(f"{title}: settled", f"regressors.p{columns}.steady", ".1f")
        per("… varying", f"regressors.p{columns}.varying", ".1f")
    for law in ("flicker", "moving_average", "walk_and_markov"):
        per(f"{law} alone, per (node, sample, axis): settled", f"sums.{law}.steady", ".1f")
        per("… varying", f"sums.{law}.varying", ".1f")
    per("judgement of the model, per (bank sample, axis): random walk", "adequacy.random_walk", ".0f")
    per("… Gauss-Markov", "adequacy.gauss_markov", ".0f")
    per("… and the search for changes: random walk", "changes.random_walk", ".0f")
    per("the bank sample that ends an epoch, six axes: random walk", "adequacy.random_walk.end")
    per("… Gauss-Markov", "adequacy.gauss_markov.end")
    per("… and the search for changes: random walk", "changes.random_walk.end")
    shares: dict[str, dict[str, str]] = {"push": {}, "bank": {}}
    for target, figures in targets.items():
        seconds = RATE_HZ / MACHINES[target].systick_hz
        push = Fraction(*figures["counts"]["push"])
        bank = Fraction(*figures["counts"]["bank.steady"]) * figures["facts"]["nodes"] * AXES
        shares["push"][target] = f"{float(seconds * (push + bank / figures['facts']['block'])):.2%}"
        shares["bank"][target] = f"{float(seconds * bank):.1%}"
    clocks = ", ".join(f"{MACHINES[target].systick_hz // 10**6} MHz" for target in targets)
    row(f"share of the core ({clocks}), averaged to 1 Hz", shares["push"])
    row("… with every sample a bank sample", shares["bank"])
    per("the dearest push, averaged to 1 Hz", "push.worst")
    per("the dearest push, every sample a bank sample, filters settled", "bank.steady.worst_push")
    per("… over the first batch, which places the nodes", "bank.first.worst_push")
    per("gap, every filter", "bank.gap")
    per("report of one axis", "report")
    for stage, title in (
        ("gather", "nodes over the last samples"),
        ("truth", "every node, and the best"),
        ("fit", "lines and edges, a row a node"),
        ("sigma", "cells of σv"),
        ("values", "node values less what is expected"),
        ("spline_profile", "spline fit of the profile"),
        ("spline_sigma", "spline fit of σv's mode"),
        ("search", "search for where the likelihood counts"),
        ("sum", "integral"),
        ("weights", "node weights"),
        ("bias", "bias"),
        ("estimates", "moments and quantiles"),
        ("evidence", "evidence"),
        ("whole", "probabilities"),
    ):
        steps = max(figures["facts"][f"report.{stage}.steps"] for figures in targets.values())
        per(f"… {title}, {steps} steps", f"report.{stage}")
        per("… the longest step of them", f"report.{stage}.worst_step")
    row("telemetry frames of one axis's report", {t: str(f["counts"]["telemetry"][1]) for t, f in targets.items()})
    per("one telemetry frame", "telemetry")
    per("the paper's recursion in plain float C, per (node, σv, sample, axis)", "paper", ".1f")
    ratios = {
        t: Fraction(*f["counts"]["paper"]) / Fraction(*f["counts"]["bank.steady"])
        for t, f in targets.items()
        if "paper" in f["counts"]
    }
    row("… times as many as the settled bank's, one σv node", {t: f"{float(r):.1f}" for t, r in ratios.items()})
    row(f"… and with {SIGMAS} σv nodes", {t: f"{float(SIGMAS * r):.0f}" for t, r in ratios.items()})
    row("**application: one sample of six axes at 819.2 Hz, averaged to 1 Hz**", {})
    periods = {t: Fraction(f["facts"]["mhz"] * 10**6) / RATE_HZ for t, f in targets.items() if "mhz" in f["facts"]}
    row("clock, MHz", {t: str(targets[t]["facts"]["mhz"]) for t in periods})
    row("instructions a sample period has", {t: f"{float(period):,.0f}" for t, period in periods.items()})

    def sample(title: str, instructions: dict[str, Fraction]) -> None:
        row(title, {t: f"{float(number):,.0f}" for t, number in instructions.items()})
        row("… of the sample period", {t: f"{float(n / periods[t]):.1%}" for t, n in instructions.items()})

    counts = {t: {name: Fraction(*count) for name, count in targets[t]["counts"].items()} for t in periods}
    between = ", ".join(f"{MACHINES[t].report_s} s" for t in periods if MACHINES[t].image)
    reports = {t: AXES * counts[t]["report"] / (MACHINES[t].report_s * RATE_HZ) for t in periods}
    sample("average sample without reports", {t: counts[t]["sample"] for t in periods})
    sample(f"… and a report of all axes every {between}", {t: counts[t]["sample"] + reports[t] for t in periods})
    sample("longest turn of the main loop between reports", {t: counts[t]["sample.worst"] for t in periods})
    number("samples that wait at most", "facts", "sample.most_waiting")
    worst = {t: counts[t]["sample.report.worst"] for t in periods}
    sample("… and in a report: samples that wait, and its slice", worst)
    number("samples that wait at most in a report", "facts", "report.most_waiting")
    number("report of one axis, from its beginning, ms", "facts", "report.ms")
    per("stationary gate, one sample", "gate", ".1f")
    per("… with a step of its thresholds", "gate.step")
    per("… at the end of a window", "gate.judge")
    per("… of one with samples missing, whose threshold is worked out there", "gate.part")
    row("**bytes**", {})
    for path in sorted((ROOT / "lib").glob("*.c")):
        number(f"flash, {path.name}", "sizes", f"text.{path.stem}")
    number("flash, library", "sizes", "text.library")
    number("… linked with `--gc-sections`", "sizes", "linked.library")
    number("… of that intake, bank, kernel, report, telemetry", "sizes", "linked.always")
    number("… and what it draws from libm, libc, libgcc", "sizes", "linked.runtime")
    number("flash, tables of the model", "sizes", "linked.tables")
    row("**what a product places**, bytes, reports of all axes kept; M4F: judged", {})
    placed = {t: {n: f["sizes"].get(f"place.{n}", 0) for n in PLACED} for t, f in targets.items()}
    for name, title in PLACED.items():
        row(title, {t: f"{of[name]:,}" for t, of in placed.items()})
    row("… all three", {t: f"{sum(of.values()):,}" for t, of in placed.items()})
    number("… and with `codegen --hold` so much more", "sizes", "place.held")
    for name in CALLS:
        number(f"stack of `{name}()`", "sizes", f"firmware.stack.{name}")
    row("**parts for a pipe of one's own**, bytes", {})
    number("RAM, `SELFCAL_SIZE`, six axes", "sizes", "ram.SELFCAL_SIZE")
    for name in ("selfcal_t", "selfcal_work_t", "selfcal_report_t", "selfcal_telemetry_t"):
        number(f"RAM, `{name}`", "sizes", f"ram.{name}")
    rams = {t: {name: size for name, size in f["sizes"].items() if name.startswith("ram.")} for t, f in targets.items()}
    a_node = {t: ram["ram.SELFCAL_SIZE"] // targets[t]["facts"]["nodes"] for t, ram in rams.items()}
    row("… of which one node", {t: f"{size:,}" for t, size in a_node.items()})
    row("**whole image**, bytes", {t: MACHINES[t].image for t in targets})
    number("flash", "sizes", "firmware.flash")
    number("RAM of the variables", "sizes", "firmware.ram")
    number("stack, worst case by the call graph, interrupts upon it", "sizes", "firmware.stack")
    heading = ["", *map(_core, targets)]
    width = LINE - 14 * len(targets) - 4

    def line(title: str, cells: list[str]) -> str:
        """Aligned where there is room."""
        aligned = f"| {title:{width}} |" + "".join(f" {cell:>11} |" for cell in cells)
        return aligned if len(aligned) <= LINE else f"| {' | '.join([title, *cells])} |"

    lines = [line(heading[0], heading[1:]), f"|{'-' * (width + 2)}|" + f"{'-' * 12}:|" * len(targets)]
    lines += [line(title, cells) for title, cells in rows]
    return "\n".join(lines)


def _core(target: str) -> str:
    return target.removeprefix("cortex-").replace("m4f", "M4F").replace("m0", "M0")


def product_table(bench: Bench) -> str:
    """What a product with the default model pays, as a markdown table for the library's page."""
    targets = bench["targets"]
    lines = [
        f"| default model, six axes; on the M4F judged | {' | '.join(_core(t) for t in targets)} |",
        "|---|" + "---:|" * len(targets),
    ]

    def row(title: str, value: Callable[[Figures], float | Fraction]) -> None:
        lines.append(f"| {title} | {' | '.join(f'{round(value(figures)):,}' for figures in targets.values())} |")

    def count(name: str) -> Callable[[Figures], Fraction]:
        return lambda figures: Fraction(*figures["counts"][name])

    def longest_step(figures: Figures) -> int:
        return max(n for name, (n, _) in figures["counts"].items() if name.endswith(".worst_step"))

    row(
        "RAM that you place, bytes: the three objects of the example",
        lambda f: sum(f["sizes"][f"place.{n}"] for n in PLACED),
    )
    row("… with `codegen --hold` so much more", lambda f: f["sizes"]["place.held"])
    row("stack of `selfcal_imu_sample()`, bytes", lambda f: f["sizes"]["firmware.stack.selfcal_imu_sample"])
    row("… of `selfcal_imu_work()`", lambda f: f["sizes"]["firmware.stack.selfcal_imu_work"])
    row(
        "flash, linked, bytes: library and `libm`",
        lambda f: f["sizes"]["linked.library"] + f["sizes"]["linked.runtime"],
    )
    row("… tables", lambda f: f["sizes"]["linked.tables"])
    row("instructions of a sample at 819.2 Hz, on average", count("sample"))
    row("… of the longest turn with one", count("sample.worst"))
    row("… and of one that ends an epoch of the judgement", count("adequacy.random_walk.end"))
    row("instructions of a report of one axis", count("report"))
    row("… of its longest call", longest_step)
    return "\n".join(lines)


def host_table(host: dict[str, dict[str, float]]) -> str:
    """ns on this machine as a markdown table."""
    lines = [
        "| ns per (node, sample, axis), one thread | library, settled | textbook filter (Eigen) "
        f"| ratio | with {SIGMAS} σv nodes |",
        "|---|---:|---:|---:|---:|",
    ]
    for variant, ns in host.items():
        ratio = ns["textbook"] / ns["library"]
        lines += [f"| {variant} | {ns['library']:.3f} | {ns['textbook']:.2f} | {ratio:.0f} | {SIGMAS * ratio:.0f} |"]
    return "\n".join(lines)


def read_reference() -> Bench:
    """counts.json; nothing in it if it is not there yet."""
    if not REFERENCE.exists():
        return {"compiler": "", "targets": {}}
    reference: Bench = json.loads(REFERENCE.read_text(encoding="utf-8"))
    return reference


def put_table(page: Path, rows: str) -> None:
    """The rows in the place of those that the page has. Raises BenchError if it has no place."""
    text, found = TABLE.subn(lambda match: match[1] + rows + match[2], page.read_text(encoding="utf-8"))
    if found != 1:
        raise BenchError(f"{page}: no place for the table")
    page.write_text(text, encoding="utf-8")


def main() -> int:
    """Measure, print, compare."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--table", action="store_true", help="print counts.json as markdown; measure nothing")
    parser.add_argument("--product", action="store_true", help="print that of lib/README.md alike")
    parser.add_argument("--host", action="store_true", help="measure ns on this machine as well")
    parser.add_argument("--accept", action="store_true", help="write counts.json and the table of tests/COST.md anew")
    arguments = parser.parse_args()
    if arguments.table or arguments.product:
        print((table if arguments.table else product_table)(read_reference()))
        return 0
    with ThreadPoolExecutor() as pool:
        figures = dict(zip(MACHINES, pool.map(measure, MACHINES), strict=True))
    compiler = run(["arm-none-eabi-gcc", "-dumpfullversion"]).strip()
    now: Bench = {"compiler": f"arm-none-eabi-gcc {compiler}", "targets": figures}
    host = measure_host() if arguments.host else {}  # after the emulators, which would disturb it
    (BUILD.parent / "bench.json").write_text(json.dumps(now | {"host_ns": host}, indent=1) + "\n", encoding="utf-8")
    print(table(now))
    if host:
        print(f"\n{host_table(host)}")
    if arguments.accept:
        REFERENCE.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
        put_table(DOCUMENT, table(now))
        put_table(PAGE, product_table(now))
        return 0
    before = read_reference()
    if before["compiler"] not in ("", now["compiler"]):
        print(f"NOT COMPARED: {REFERENCE.name} was made with {before['compiler']}, this is {now['compiler']}")
        return 0
    complaints = compare(now, before)
    for line in complaints:
        print(line)
    if complaints:
        print("Not as in counts.json. If that is meant, `make bench ACCEPT=1` and say why in the commit.")
    return 1 if complaints else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except BenchError as failure:
        print(f"bench: {failure}", file=sys.stderr)
        sys.exit(1)
