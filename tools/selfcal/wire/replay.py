"""`selfcal replay`: the firmware itself over a recording; its telemetry decoded and shown."""

from __future__ import annotations

import fcntl
import hashlib
import math
import os
import re
import shlex
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from selfcal.adequacy.checks import Judged
from selfcal.adequacy.identify import Fed, concluded, may_act, with_reasons
from selfcal.adequacy.identify_document import Identified, as_typed, identify_document
from selfcal.adequacy.one_over_f import with_white
from selfcal.adequacy.summary import summarize
from selfcal.bank.axis_result import AxisResult, in_unit
from selfcal.bank.blocks import usable_blocks
from selfcal.bank.firmware import Played
from selfcal.bank.subsets import Inclusion, ScoredSubsets, normal_coefficient
from selfcal.base.ending import hold_signals
from selfcal.base.errors import OutsidePriors, UserError, called, note
from selfcal.base.units import factor as factor_of
from selfcal.base.units import same_kind
from selfcal.diagnosis.warm import Start, warmed
from selfcal.logs.recording import SIDE_CHANNELS, Recording, as_float
from selfcal.model.file import Model
from selfcal.model.regressors import Choice, check_channels, coefficient_unit, columns_of, ln_prior, mask_of, offered
from selfcal.model.tables import Tables, bank_block, make_tables
from selfcal.readings.readings import look
from selfcal.wire.ahead import error_ahead, of_report
from selfcal.wire.c_tables import check_forms, write_tables
from selfcal.wire.frames import AXES, ROOT, TREE, AxisReport, Decoder, Link, open_bus, reasons, wire_names
from selfcal.wire.live import SILENT_S, View, frame_counts

MAGIC = b"SELFCAL2"
#: Channels of every sample apart from the model's (port/port.h); not a number if the recording lacks them.
SIDE = tuple(SIDE_CHANNELS.values())
TIMEOUT_S = 60.0  # for the host firmware without a frame, and for any to end
LONGEST_PERIOD_S = 4e6  # module time is uint32 in ms
#: Sources of a firmware, and the environment variables that its `make` file reads.
SOURCES = (".c", ".h", ".ld", ".mk")
#: Debian packages of the programs that build and run it.
PROGRAMS = {
    "make": "make",
    "cc": "gcc libc6-dev",
    "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "qemu-system-arm": "qemu-system-arm",
}
BUILD_SETTINGS = ("CC", "POSIX_CFLAGS", "QEMU_CFLAGS")


@dataclass(frozen=True)
class Target:
    """Where the firmware runs: its `make` file's name, what is made, QEMU's board, and reports of each axis in a run.

    `reports` holds unless --report-every says otherwise; an emulated core takes seconds over each.
    """

    make: str
    image: str
    reports: int
    board: tuple[str, ...] = ()

    @property
    def programs(self) -> tuple[str, ...]:
        """Members of PROGRAMS that build and run it."""
        return ("make", "arm-none-eabi-gcc", "qemu-system-arm") if self.board else ("make", "cc")

    @property
    def patience_s(self) -> float:
        """s that it may be silent."""
        return 600.0 if self.board else TIMEOUT_S


TARGETS = {
    "host": Target("posix", "selfcal-posix", 100),
    "cortex-m4f": Target("qemu", "selfcal-qemu.elf", 10, ("netduinoplus2",)),
    # The nRF51822 with 36 KB of RAM (port/qemu/qemu.mk): six axes do not fit the 16 KB of the board's own.
    "cortex-m0": Target("qemu", "selfcal-qemu.elf", 1, ("microbit", "-global", "nrf51-soc.sram-size=0x9000")),
}


def firmware_tables(model: Model, rate_hz: float, axes: Sequence[str], target: str, start: Start | None) -> Tables:
    """Tables of a firmware, with measured priors from `start`."""
    return warmed(make_tables(model, rate_hz, tuple(axes), target), start)


def build(
    model: Model,
    rate_hz: float,
    axes: Sequence[str],
    target: str = "host",
    nodes: str | None = None,
    start: Start | None = None,
) -> Path:
    """The firmware of a target for a model, a sampling rate and a choice of axes; made only if it is not there.

    `nodes`: whose node counts and sizes it gets (default: the target's own). `start`: measured priors. Its folder is
    named by the content of all that it is made of, and appears whole or not at all. Raises UserError if it cannot be
    made.
    """
    made_by = TARGETS[target]
    with tempfile.TemporaryDirectory(prefix="selfcal-") as name:
        tables = Path(name)
        made = firmware_tables(model, rate_hz, axes, nodes or target, start)
        write_tables(model, made, tables, nodes or target, start.of if start is not None else "")
        key = _content(tables, made_by.make)
        root = workshop()
        folder = root / "build" / made_by.make / (key if target == "host" else f"{target}-{key}")
        folder.parent.mkdir(parents=True, exist_ok=True)
        with folder.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not folder.is_dir():
                part = folder.with_suffix(".part")
                shutil.rmtree(part, ignore_errors=True)  # a build that was killed leaves it
                try:
                    shutil.copytree(tables, part)
                    _make(made_by.make, target, root, part.relative_to(root))
                    part.rename(folder)
                except BaseException:
                    shutil.rmtree(part, ignore_errors=True)
                    raise
    return folder / made_by.image


def workshop() -> Path:
    """The folder that firmware is made in: the source tree, or an installed wheel's copy of it in the user's cache,
    named by its content. Raises UserError if that cannot be written."""
    if not TREE.is_dir():
        return ROOT
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "selfcal"
    folder = cache / _digest([file for part in ("lib", "port") for file in sorted((TREE / part).rglob("*.*"))])
    try:
        cache.mkdir(parents=True, exist_ok=True)
        if not folder.is_dir():
            with tempfile.TemporaryDirectory(dir=cache) as name:
                for part in ("lib", "port"):
                    shutil.copytree(TREE / part, Path(name) / "tree" / part)
                with suppress(FileExistsError):  # another was faster
                    (Path(name) / "tree").rename(folder)
    except OSError as error:
        what = f"cannot make firmware there: {error.strerror} (XDG_CACHE_HOME names another place)"
        raise UserError(f"{cache}: {what}") from error
    return folder


def _content(tables: Path, name: str) -> str:
    """Names what a firmware is made of: its tables, every source, and settings that its `make` file takes."""
    folders = [ROOT / "lib", ROOT / "port", *(ROOT / "port" / part for part in ("app", "replay", name)), tables]
    files = [file for folder in folders for file in sorted(folder.glob("*.*")) if file.suffix in SOURCES]
    return _digest(files, repr([os.environ.get(setting) for setting in BUILD_SETTINGS]))


def _digest(files: Sequence[Path], more: str = "") -> str:
    """Names the content of `files`."""
    said = hashlib.sha256(more.encode())
    for file in files:
        said.update(f"\0{file.name}\0".encode())
        said.update(hashlib.sha256(file.read_bytes()).digest())
    return said.hexdigest()[:16]


def _make(name: str, target: str, root: Path, folder: Path) -> None:
    """Make a firmware in `folder`, which is relative to `root`: a path to that may hold spaces."""
    check_programs(target)
    command = ["make", "-s", "-f", f"port/{name}/{name}.mk", name, f"MODEL_DIR={folder}", f"OUT={folder}"]
    # Do not pass on the options and variables of a `make` around this program.
    environment = {key: value for key, value in os.environ.items() if key not in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL")}
    try:
        command.append(f"CORE={target}")
        done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)
    except OSError as failure:
        raise UserError(f"cannot build the firmware: make: {failure.strerror}") from failure
    if done.returncode != 0:
        # The compiler's first error, else the first line: a linker's, or make's own.
        error = re.search(r":\d+: (?:fatal )?error: (.+)", done.stderr)
        lines = (line for line in done.stderr.splitlines() if line.strip())
        complaint = error[1] if error else next(lines, "make failed")
        remedy = ": take fewer axes (--axis), laws or nodes" if "does not fit the RAM" in complaint else ""
        raise UserError(f"cannot build the firmware: {complaint}{remedy}")


def check_programs(target: str) -> None:
    """Raises UserError where a program is missing that the firmware of `target` is built or run by."""
    chosen = shlex.split(os.environ.get("CC", ""))  # with its options
    asked = {name: chosen[0] if name == "cc" and chosen else name for name in TARGETS[target].programs}
    missing = [name for name, program in asked.items() if shutil.which(program) is None]
    if missing:
        packages = " ".join(PROGRAMS[name] for name in missing)
        what = f"firmware for the {target}" if TARGETS[target].board else "a program for this machine"
        raise UserError(
            f"{what} is compiled, and there is no {' and no '.join(missing)} here: on Debian `apt install {packages}`; "
            "plain `replay` compiles nothing"
        )


def write_rows(recording: Recording, model: Model, axes: Sequence[str], path: Path) -> None:
    """The recording as the firmware reads it (port/replay/replay.h): float32 in the model's units."""
    units = [(name, model.group_of(name).unit) for name in axes]
    channels = make_tables(model, recording.rate_hz, tuple(axes)).channels
    check_channels(model.regressors, recording)
    wanted = (*units, *channels, *SIDE)
    rows = np.zeros(recording.samples, dtype=[("missing", "<u4"), ("value", "<f4", (len(wanted),))])
    rows["missing"] = recording.missing_before
    for index, (name, unit) in enumerate(wanted):
        there = name in recording.columns and same_kind(recording.columns[name].unit, unit)
        recorded = there or (name, unit) not in SIDE
        rows["value"][:, index] = as_float(recording.in_unit(name, unit)) if recorded else np.nan
    header = np.array(
        [(MAGIC, len(axes), len(channels) + len(SIDE), recording.rate_hz, recording.samples, recording.powered)],
        dtype="S8, <u4, <u4, <f8, <u8, <u8",
    )
    with path.open("wb") as file:
        file.write(header.tobytes())
        file.write(rows.tobytes())


def run_firmware(
    firmware: Path | None,
    recording: Recording,
    model: Model,
    axes: Sequence[str],
    report_every: float | None,
    target: str = "host",
    gate: bool = False,
    transport: str = "slcan",
    channel: str = "",
    start: Start | None = None,
) -> tuple[dict[str, list[AxisReport]], dict[str, str]]:
    """Play the recording through the firmware; None: by the application in this process, with measured priors from
    `start`. The complete reports of each axis, and why axes have no calibration to rely on at the end. Prints the
    frame counts, and the gate's."""
    if firmware is None:
        check_forms(model)
    period_s = period_of(recording, model, report_every, target)
    history: dict[str, list[AxisReport]] = {name: [] for name in axes}
    decoder = Decoder(from_start=True)
    with tempfile.TemporaryDirectory(prefix="selfcal-") as name:
        rows = Path(name) / "rows.bin"
        write_rows(recording, model, axes, rows)
        watch = partial(_watch, decoder=decoder, recording=recording, model=model, history=history)
        if firmware is None:
            tables = firmware_tables(model, recording.rate_hz, axes, "host", start)
            try:
                watch(Played(model, tables, rows, ms(period_s), gate))
            except ValueError as error:  # std::invalid_argument
                raise UserError(f"{recording.path}: {error}") from error
        else:
            with ExitStack() as stack:
                link, more = None, ["--timeout", f"{TIMEOUT_S:g}"]
                if transport == "can":  # listening first: on a bus nobody waits for a listener
                    bus, link = can_bus(channel)
                    stack.enter_context(link)
                    more += ["--can", bus]
                module, wire, before = stack.enter_context(running(firmware, rows, period_s, target, gate, more))
                if link is None and wire:
                    # The firmware is ready at once: python-can's pause after opening is for modules that restart.
                    link = stack.enter_context(open_bus("slcan", wire, bitrate=500000, sleep_after_open=0.0))
                if link is not None and wire:
                    watch(link, module=module, patience_s=TARGETS[target].patience_s)
                    link.order("close")  # the emulator forgets what it holds of a line that is closed
                said = before + _ending(module)
            if module.returncode != 0 or not decoder.finished:
                said = said.strip().replace(str(rows), str(recording.path)).replace(rows.name, str(recording.path))
                raise UserError(said or f"the firmware stopped before its last report (exit code {module.returncode})")
    return history, reasons(decoder.status, decoder.corrected)


def period_of(recording: Recording, model: Model, report_every: float | None, target: str) -> float:
    """Seconds between reports."""
    bank_s = bank_block(recording.rate_hz, model.bank_rate_hz) / recording.rate_hz
    wanted_s = report_every or min(recording.duration_s / TARGETS[target].reports, LONGEST_PERIOD_S)
    return max(wanted_s, bank_s)  # between two bank samples nothing changes


def ms(period_s: float) -> int:
    """A period in whole milliseconds, as port/posix/main.c rounds what it is given."""
    return math.ceil(float(f"{period_s:.6f}") * 1000.0)


def can_bus(channel: str) -> tuple[str, Link]:
    """A CAN bus between programs of this machine: its name for the firmware (port/posix/can.h), and the host's link.

    The CAN device `channel`, or else UDP in python-can's multicast group at a free port.
    """
    from can.interfaces.udp_multicast import UdpMulticastBus

    if channel:
        return channel, open_bus("socketcan", channel)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    group = UdpMulticastBus.DEFAULT_GROUP_IPv4
    return f"{group}:{port}", open_bus("udp_multicast", group, port=port)


def _ending(module: subprocess.Popen[str]) -> str:
    """Output of the firmware from here on, its channel being closed."""
    try:
        return module.communicate(timeout=TIMEOUT_S)[0]
    except subprocess.TimeoutExpired:
        raise UserError(f"the firmware did not end within {TIMEOUT_S:g} s of its last frame") from None


@contextmanager
def running(
    firmware: Path, rows: Path, period_s: float, target: str, gate: bool = False, more: Sequence[str] = ()
) -> Iterator[tuple[subprocess.Popen[str], str, str]]:
    """The running firmware, the channel its telemetry comes by, and what it said before; killed at the end. The host's
    ends by itself where this process is killed before.

    `more`: arguments for the host's (port/posix/main.c). The channel is empty if the firmware ended before it opened
    a channel.
    """
    with socket.create_server(("127.0.0.1", 0)) if TARGETS[target].board else nullcontext() as server:
        if server is None:
            command = [str(firmware), str(rows), "--report-every", f"{period_s:.6f}", "--leash", *more]
            command += ["--gate"] if gate else []
        else:  # QEMU takes over a socket that listens already, so no port can be lost to another program
            uart = f"socket,id=uart,server=on,wait=off,fd={server.fileno()}"
            command = emulator(firmware, rows.name, period_s, target, uart, gate)
        with hold_signals() as ending:  # a signal between start and `try` would leave it running
            leash, end_of_leash = os.pipe()  # its end closes with this process, whatever ends that
            try:
                module = subprocess.Popen(
                    command,
                    cwd=rows.parent,
                    stdin=leash,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                    errors="replace",
                    pass_fds=() if server is None else (server.fileno(),),
                )
            except OSError as error:
                os.close(end_of_leash)
                raise UserError(f"cannot run the firmware: {command[0]}: {error.strerror}") from error
            finally:
                os.close(leash)
        try:
            ending.check()
            assert module.stdout is not None
            channel = said = ""
            for line in module.stdout:
                word, _, rest = line.strip().partition(" ")
                if word in ("SELFCAL_PTY", "SELFCAL_CAN"):
                    channel = rest
                elif word == "SELFCAL_UART" and server is not None:
                    channel = f"socket://127.0.0.1:{server.getsockname()[1]}"
                if channel:
                    break
                said += line
            yield module, channel, said
        finally:
            module.kill()
            module.wait()
            os.close(end_of_leash)


def emulator(firmware: Path, rows: str, period_s: float, target: str, uart: str, gate: bool = False) -> list[str]:
    """QEMU's command line for a firmware over the file `rows` of its folder; `uart`: a -chardev with id=uart."""
    return [
        *("qemu-system-arm", "-M", *TARGETS[target].board, "-display", "none", "-monitor", "none"),
        *("-chardev", uart, "-serial", "chardev:uart", "-kernel", str(firmware)),
        "-semihosting-config",
        f"enable=on,target=native,arg=selfcal,arg={rows},arg={ms(period_s)}" + (",arg=gate" if gate else ""),
    ]


def _watch(
    link: Link | Played,
    decoder: Decoder,
    recording: Recording,
    model: Model,
    history: dict[str, list[AxisReport]],
    module: subprocess.Popen[str] | None = None,
    patience_s: float = math.inf,
) -> None:
    """Follow the telemetry until the module has finished, or fallen silent. Of `history` retired axes without a report
    are taken out. `module`: its program, if any."""
    whole: dict[str, bool] = {}  # the axis's last report
    title = f"{recording.path.name}{' (SIMULATED)' if recording.meta.get('simulated') else ''}"
    with View(decoder, link, title, recording.duration_s, names=lambda status: wire_names(model)) as view:
        heard = time.monotonic()
        while not decoder.finished:
            frame = link.recv(1.0)
            if frame is None:
                silent_s = time.monotonic() - heard
                ended = module is not None and module.poll() is not None
                if link.closed or silent_s > (SILENT_S if ended else patience_s):
                    break
                continue
            heard = time.monotonic()
            reports = decoder.feed(frame)
            if decoder.surely_foreign:
                raise UserError(f"{recording.path}: {decoder.foreign}")
            view.show(reports)
            for report in reports:
                whole[report.axis] = report.complete
                if report.complete:
                    history[report.axis].append(report)
    said = frame_counts(decoder, link)
    if decoder.status.get("motion", 0.0) > 0.0:
        alarms, blocks = (decoder.status.get(name, 0.0) for name in ("gate_alarm_count", "blocks_moving_count"))
        said += f"\ngate: rest ended {alarms:.0f} times; {blocks:.0f} bank intervals begun and given up for motion"
    for name in [name for name in history if not whole.get(name, True)]:
        said += f"\n{name}: its last report did not arrive whole; its numbers are from the one before"
    retired = int(decoder.status.get("axes_retired", 0.0))
    for name in [name for name in history if retired >> AXES.index(name) & 1]:
        said += f"\n{name}: retired as dead on the way; "
        if history[name]:
            said += "its last report is from before"
        else:
            said += "left out: it has no report from before"
            del history[name]
    Console(stderr=True).print(said, highlight=False, soft_wrap=True)


def wire_document(
    recording: Recording, model: Model, history: Mapping[str, Sequence[AxisReport]], why: Mapping[str, str], gate: bool
) -> dict[str, Any]:
    """The document `selfcal.identify/1` of what telemetry carried."""
    identified: dict[str, Identified | UserError] = {}
    for name, reports in history.items():
        try:
            identified[name] = _identified(recording, model, name, reports, gate)
        except UserError as error:
            identified[name] = error
    with_reasons(identified, recording, model)
    document = identify_document(recording, identified)
    again = f"{called()} diagnose {as_typed(document['recording'])}"
    for name, axis in document["axes"].items():
        axis["module_reason"] = why.get(name)
        if "error" not in axis:
            judgement = history[name][-1].adequacy
            axis["module_says"] = asdict(judgement) if judgement is not None else None
            stated = [] if gate else [of_report(report, model) for report in history[name]]
            axis["ahead"] = None if gate else error_ahead(recording, model, name, stated)
            axis["outliers_kept_out"] = int(history[name][-1].values.get("outliers", 0))
            if judgement is not None and judgement.change is not None and judgement.state != "inadequate":
                note(f"{name}: the module says {judgement.change}; the checks here look at the record as one")
            if judgement is not None and judgement.state == "inadequate":
                note(f"{name}: the module says {judgement}; why, and what mends it: {again}")
    if gate:
        for axis in (axis for axis in document["axes"].values() if "error" not in axis):
            axis["adequate"] = None  # which samples were at rest is not in the telemetry
    return document


def _identified(recording: Recording, model: Model, name: str, history: Sequence[AxisReport], gate: bool) -> Identified:
    """An axis by the firmware's last report. The checks of its law are made here, over the same samples."""
    recording = recording.along(name)
    regressors, group, unit = offered(model, name), model.group_of(name), recording.columns[name].unit
    tables = make_tables(replace(model, regressors=regressors), recording.rate_hz, (name,))
    columns = as_float(columns_of(regressors, recording))
    samples = as_float(recording.in_unit(name, group.unit))
    blocks = usable_blocks(samples, recording.missing_before, tables, group, columns)
    if not history:
        raise UserError("too little rest for a report" if gate else "too short for a report")
    result, scored = _with_coefficients(history[-1], model, regressors, unit)
    if not any(math.isfinite(p) for p in result.probability.values()):
        raise OutsidePriors
    extent = tables.dt_s, blocks.mean.size, tables.block
    answer = in_unit(with_white(result, group, *extent), group.unit, unit)
    scored = replace(scored, result=answer) if scored else None
    if gate:  # which samples were at rest is not in the telemetry
        numbers = summarize(result, group, *extent)
        return Identified(unit, group.unit, answer, Judged({}, None), blocks.kept_out, scored, summary=numbers)
    mask = mask_of(regressors, regressors) if scored is not None and scored.best == 1 else 0
    fed = Fed(recording, look(recording, name, group), group, tables, regressors, samples, 0.0, columns, blocks)
    others = may_act(model, recording, name)
    return concluded(fed, unit, others, result, mask, result, answer, scored, as_fed=True)


def _with_coefficients(
    report: AxisReport, model: Model, regressors: Choice, unit: str
) -> tuple[AxisResult, ScoredSubsets | None]:
    """The report in the model's unit, and its regressors with coefficients per `unit`, the recording's.

    The firmware compares no regressor with all that the axis has, and sends the likelier of the two. The evidence here
    is over both, weighed by their priors, as `identify` weighs all subsets.
    """
    result = report.result(wire_names(model))
    if not regressors:
        return result, None
    coefficients = report.coefficients(wire_names(model))
    columns = [column for regressor in regressors for column in regressor.columns]
    probability = coefficients[columns[0]][2] if columns[0] in coefficients else 0.0
    if not math.isfinite(probability):
        probability = 0.0
    sent = [coefficients.get(column, (math.nan, math.nan, 0.0))[:2] for column in columns]
    used = report.in_use(probability)
    if used:
        result = replace(result, coefficients={law: tuple(sent) for law in result.probability})
    factor = factor_of(model.group_of(report.axis).unit, unit)
    inclusion = {
        regressor.name: Inclusion(
            probability,
            tuple(
                normal_coefficient(column, coefficient_unit(unit, regressor.unit), mean * factor, sd * factor)
                for column, (mean, sd) in zip(columns, sent, strict=True)
                if column in regressor.columns
            ),
        )
        for regressor in regressors
    }
    choices = ((), regressors)
    # P(data) = P(data | sent) P(sent) / P(sent | data)
    share = ln_prior(regressors, choices[used]) - math.log(max(probability, 1.0 - probability))
    evidence = {law: value + share for law, value in result.log_evidence.items()}
    result = replace(result, log_evidence=evidence)
    return result, ScoredSubsets(result, inclusion, choices, (1.0 - probability, probability), int(used))
