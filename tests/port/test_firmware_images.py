"""The images of `make firmware`: their sizes (tests/bench/image_sizes.py), their start, and `make flash`.

Truth of the stack's bound: the deepest that a run in the emulator went, painted and looked at (a bound may only be
above it), and small programs whose depth can be counted by hand.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import image_sizes
import pytest
from firmware import ROOT, image
from image_sizes import FirmwareError, Image

from selfcal.logs import recording as recording_module
from selfcal.logs.recording import load
from selfcal.model.file import Model
from selfcal.verbs.codegen import codegen
from selfcal.wire.command import build_flag
from selfcal.wire.frames import load_dbc
from selfcal.wire.replay import TARGETS, build, emulator, write_rows

#: Frames of a status: the items that the DBC has.
STATUS = len({s.multiplexer_ids[0] for s in load_dbc().get_message_by_name("STATUS").signals if s.multiplexer_ids})
#: Frames of a report of the default model; the Cortex-M0 does not judge it.
REPORT = {"cortex-m4f": 52, "cortex-m0": 46}
CORES = {"cortex-m4f": ["-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"], "cortex-m0": ["-mcpu=cortex-m0"]}
APP = ("app.c", "app_frames.c", "app_reports.c", "app_state.c")
#: What the emulated image calls through: main()'s port_t is a variable there, so its functions are named.
CALLS = {"intake.c": ["selfcal_regressors_code?"], "adequacy.c": ["look?"]} | {
    **{file: ["selfcal_regressors_code?", "selfcal_states_code?"] for file in ("check.c", "report_bias.c")},
    "report.c": ["selfcal_regressors_code?"],
    "report.c:selfcal_report_step": ["stages"],
    "report_node.c": ["selfcal_regressors_code?"],
    "bank.c": ["selfcal_regressors_code?", "selfcal_states_code?", "selfcal_kernel_run"],
    "snapshot.c": [],
    "imu.c": [f"selfcal_{part}_code?" for part in ("gate", "columns", "judging", "changes")],
    "imu_judge.c": ["selfcal_columns_code?"],
    **{file: ["board_time_ms", "board_sample", "board_send", "board_idle"] for file in APP},
    "replay.c": ["board_read"],
}


@pytest.fixture(scope="module")
def images() -> None:
    subprocess.run(["make", "-s", "firmware-images"], cwd=ROOT, check=True, capture_output=True)


def link(folder: Path, source: str, core: str = "cortex-m0") -> Image:
    """An image of one C file with a vector table of its own."""
    (folder / "objects").mkdir()
    (folder / "small.c").write_text(source)
    compiler = ["arm-none-eabi-gcc", "-mthumb", *CORES[core], "-O2", "-std=c99"]
    options = ["-g", "-fstack-usage", "-fno-inline", "-fno-optimize-sibling-calls", "-c", "../small.c"]
    subprocess.run([*compiler, *options], cwd=folder / "objects", check=True)
    layout = ["-nostartfiles", "-Wl,-e,start,-Ttext=0,-Tdata=0x20000000,--defsym=end=0"]
    subprocess.run([*compiler, *layout, "objects/small.o", "-o", "small.elf"], cwd=folder, check=True)
    return Image(folder / "small.elf")


START = "extern volatile int sink;\nvolatile int sink;\nvoid start(void);\n"
VECTORS = "const void *const vectors[16] = {0, (const void *)start};\n"


@pytest.mark.parametrize("core", CORES)
def test_a_stack_counted_by_hand(core: str, tmp_path: Path) -> None:
    """start 8 (r4, lr), deep 400 + 8 or more, leaf 0; aligned to 8, so the sum lies between 416 and 448."""
    source = (
        "void leaf(volatile int *at); void leaf(volatile int *at) { *at = 1; }\n"
        "void deep(void); void deep(void) { volatile int room[100]; leaf(room); sink = room[0]; }\n"
        "void start(void) { deep(); sink = 2; }\n"
    )
    size, path = link(tmp_path, START + source + VECTORS, core).stack({})
    assert 416 <= size <= 448
    assert [step.split()[0] for step in path.split(" > ")] == ["start", "deep", "leaf"]


def test_a_call_through_a_table(tmp_path: Path) -> None:
    """The deepest function of the table that the caller's file is said to use."""
    source = (
        "void low(void); void low(void) { sink = 1; }\n"
        "void deep(void); void deep(void) { volatile int room[100]; room[0] = 1; sink = room[0]; }\n"
        "extern void (*const table[2])(void); void (*const table[2])(void) = {low, deep};\n"
        "void start(void) { table[sink & 1](); sink = 2; }\n"
    )
    size, path = link(tmp_path, START + source + VECTORS).stack({"small.c": ["table"]})
    assert 408 <= size <= 432
    assert [step.split()[0] for step in path.split(" > ")] == ["start", "deep"]


@pytest.mark.parametrize(
    ("source", "complaint"),
    [
        ("int f(int n); int f(int n) { return n < 2 ? n : f(n - 1) * f(n - 2) + sink; }\n"
         "void start(void) { sink = f(sink); }\n", "recursion: f"),
        ("void start(void) { ((void (*)(void))sink)(); sink = 1; }\n", "start in small.c calls by pointer"),
        ("void start(void) { volatile char room[sink]; room[0] = 1; sink = room[sink]; }\n", "frame"),
    ],
)  # fmt: skip
def test_what_has_no_bound_is_refused(source: str, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(FirmwareError, match=complaint):
        link(tmp_path, START + source + VECTORS).stack({})


@pytest.mark.parametrize("core", CORES)
def test_the_stack_stays_below_its_bound(core: str, tmp_path: Path) -> None:
    """And the bound is not idle: a run with reports goes at least two thirds as deep."""
    whole = load(ROOT / "tests" / "data" / "simulated_adis16405.npz")
    columns = {
        axis: (whole.columns[axis].unit, whole.in_unit(axis, whole.columns[axis].unit)[:600]) for axis in ("gx", "ax")
    }
    recording_module.save(tmp_path / "part.npz", columns, whole.rate_hz, {})
    recording = load(tmp_path / "part.npz")
    model = Model.load()
    program = build(model, recording.rate_hz, ("gx", "ax"), core)
    settings = [f"MODEL_DIR={program.parent}", f"OUT={tmp_path}", f"CORE={core}"]
    settings += ["QEMU_CFLAGS=-DQEMU_STACK"]
    subprocess.run(["make", "-s", "-f", "port/qemu/qemu.mk", "qemu", *settings], cwd=ROOT, check=True)
    write_rows(recording, model, ("gx", "ax"), tmp_path / "rows.bin")
    module = subprocess.Popen(
        emulator(tmp_path / TARGETS[core].image, "rows.bin", 20.0, core, "stdio,id=uart,signal=off"),
        cwd=tmp_path,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert module.stderr is not None and module.stdin is not None and module.stdout is not None
    assert module.stderr.readline() == b"SELFCAL_UART\n"
    module.stdin.write(b"O\r")
    module.stdin.flush()
    module.stdout.read(1 + 22 * (3 * (STATUS + 2 * REPORT[core]) + STATUS))
    _, errors = module.communicate(b"C\r", timeout=60)
    found = re.fullmatch(rb"stack (\d+)\n", errors)
    assert found, errors
    assert module.returncode == 0
    bound, path = Image(tmp_path / TARGETS[core].image).stack(CALLS)
    print(f"{core}: went {int(found[1])}, bound {bound}: {path}")
    assert int(found[1]) <= bound
    assert int(found[1]) >= bound * 2 / 3


@pytest.mark.usefixtures("images")
def test_the_images_keep_their_budgets(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["image_sizes.py", *image_sizes.TARGETS])
    assert image_sizes.main() == 0
    table = capsys.readouterr().out
    for target in image_sizes.TARGETS:
        sizes, _ = image_sizes.measure(target)
        binary = (ROOT / "build" / target / "selfcal.bin").stat().st_size
        assert sizes["flash"] == pytest.approx(binary, abs=16)  # what is burnt, but for the filling between sections
        assert re.search(rf"^{target} +{sizes['flash']:,} ", table, re.MULTILINE)
        assert (ROOT / "build" / target / "selfcal.hex").read_text().endswith(":00000001FF\n")
    tight = image_sizes.read_budget("cortex-m0") | {"stack": 100}
    monkeypatch.setattr(image_sizes, "read_budget", lambda target, sensor: tight)
    monkeypatch.setattr(sys, "argv", ["image_sizes.py", "cortex-m0"])
    assert image_sizes.main() == 1
    assert "cortex-m0: stack is " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("target", "flags"),
    [
        ("stm32f405", "-DBOARD_CAN_KBITPS=250 -DAPP_CORRECTED_MS=100"),
        ("stm32f405", f"-DBOARD_CAN_KBITPS=0 -DAPP_CORRECTED_MS=100 {build_flag(bytes(16))}"),
        ("cortex-m0", build_flag(bytes(16))),
    ],
)
def test_images_with_settings_keep_the_budgets(target: str, flags: str) -> None:
    """With all that can be built in (port/README.md, Settings)."""
    elf = image(f"settings-{target}-{len(flags)}", flags, target=target)
    configured, budget = Image(elf), image_sizes.read_budget(target)
    assert configured.flash() <= budget["flash"]
    assert configured.ram() <= budget["ram"]
    assert configured.stack(budget["calls"], budget["giving_way"])[0] <= budget["stack"]


@pytest.mark.usefixtures("images")
@pytest.mark.parametrize(
    ("source", "flag", "complaint"),
    [
        ("app/module.c", "-DBOARD_SAVE_PERIOD_S=0", "BOARD_SAVE_PERIOD_S: 1 to"),
        ("app/module.c", "-DBOARD_SAVE_PERIOD_S=4294968U", "BOARD_SAVE_PERIOD_S: 1 to"),
        ("sensors/adis16405.c", "-DSENSOR_QUEUE=1000", "SENSOR_QUEUE must be a power of two"),
        ("app/app_commands.c", "-DAPP_COMMAND_KEY=0x1ULL", "the_key_has_two_halves"),
        ("stm32f405/main.c", "-DBOARD_REPORT_MS=0", "BOARD_REPORT_MS: 100 to"),
        ("stm32f405/main.c", "-DBOARD_CAN_KBITPS=800", "BOARD_CAN_KBITPS: 125 to 1000"),
        ("stm32f405/main.c", "-DBOARD_USART_BAUD=1200", "BOARD_USART_BAUD: 9600 to"),
        ("stm32f405/clock.c", "-DBOARD_HSE_HZ=12288000", "BOARD_HSE_HZ: 4000000 to 26000000, whole MHz"),
        ("cortex-m0/main.c", "-DBOARD_CAN_KBITPS=500", "this board's wire is SLCAN"),
    ],
)
def test_options_that_cannot_work_do_not_compile(source: str, flag: str, complaint: str) -> None:
    target, core = ("cortex-m0", "cortex-m0") if "cortex-m0" in source else ("stm32f405", "cortex-m4f")
    model = ROOT / "build" / target / "model"
    assert said_of(source, model, core) == ""
    assert complaint in said_of(source, model, core, flag)


#: As the data sheet has them.
RATES = "the icm42688 has 25, 50, 100, 200, 500 or 1000 Hz"


@pytest.mark.parametrize(
    ("rate", "channel", "complaint"),
    [
        (200.0, "temp, unit: degC", ""),
        (1000.0, "temp, unit: degC", ""),
        (819.2, "temp, unit: degC", f"the model's rate is 819.2F Hz, {RATES}: set sensor.rate_hz"),
        (400.0, "temp, unit: degC", f"the model's rate is 400.0F Hz, {RATES}: set sensor.rate_hz"),
        (100.0, "supply, unit: V", "reads a channel that the icm42688 has not"),
        (100.0, "fan, unit: degC", "reads a channel that the icm42688 has not"),
    ],
)
def test_models_that_the_other_sensor_cannot_keep_do_not_compile(
    rate: float, channel: str, complaint: str, tmp_path: Path
) -> None:
    """The rates of the data sheet; a temperature and no supply."""
    text = Model.load("icm42688p").path.read_text()
    regressor = f"regressors: [{{name: x, kind: column, column: {channel}, reference: 5, sd: {{gyro: 0.5}}}}]\n"
    (tmp_path / "model.yaml").write_text(text + regressor)
    codegen(tmp_path / "model.yaml", tmp_path, target="cortex-m4f", rate=rate)
    said = said_of("app/readings.c", tmp_path, sensor="icm42688")
    assert complaint in said
    assert (said == "") == (complaint == "")


def test_a_sensor_and_its_model_file_have_one_lattice() -> None:
    """Of the data sheet; test_icm42688.py holds the driver's readings against the same steps."""
    gyro, accel = Model.load("icm42688p").groups
    assert (gyro.range, gyro.lsb) == pytest.approx((2000.0, 2000.0 / 2**18), rel=1e-7)
    assert (accel.range, accel.lsb) == pytest.approx((16.0 * 9.80665, 16.0 * 9.80665 / 2**17), rel=1e-7)


def said_of(source: str, model: Path, core: str = "cortex-m4f", *flags: str, sensor: str = "adis16405") -> str:
    """What the compiler has against a source with the model of a folder; it fails if that is anything."""
    folders = [f"-I{folder}" for folder in ("lib", "port", "port/app", "port/sensors", model)] + [f"-DSENSOR={sensor}"]
    compiler = ["arm-none-eabi-gcc", "-std=c99", "-mthumb", "-Wall", "-Wextra", "-Wpedantic", *CORES[core], *folders]
    command = [*compiler, "-Os", "-c", f"port/{source}", "-o", os.devnull, *flags]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode != 0) == (done.stderr != "")
    return done.stderr


@pytest.mark.parametrize(
    ("source", "old", "new", "complaint"),
    [
        ("app/app.c", "", "", ""),
        ("app/app.c", "unit: deg/s", "unit: rad/s", "each axis of the model must be one that telemetry has"),
        ("app/app.c", "unit: m/s^2", "unit: mg", "each axis of the model must be one that telemetry has"),
        ("app/app.c", "[gx, gy, gz]", "[gx, gy, w]", "each axis of the model must be one that telemetry has"),
        # by 1638.4 / n Hz, n = 1 .. 128, of the data sheet, to 0.1 %
        ("app/readings.c", "819.2", "546.1", ""),
        ("app/readings.c", "819.2", "12.8", ""),
        ("app/readings.c", "819.2", "12.7", "set sensor.rate_hz in the model file"),
        ("app/readings.c", "819.2", "821.0", "set sensor.rate_hz in the model file"),
        ("app/readings.c", "819.2", "100.0", "set sensor.rate_hz in the model file"),
        ("app/readings.c", "819.2", "1638.4", "set sensor.rate_hz in the model file"),  # two bursts do not fit
    ],
)
def test_models_that_the_board_cannot_keep_do_not_compile(
    source: str, old: str, new: str, complaint: str, tmp_path: Path
) -> None:
    (tmp_path / "model.yaml").write_text(Model.load().path.read_text().replace(old, new))
    codegen(tmp_path / "model.yaml", tmp_path, target="cortex-m4f")
    said = said_of(source, tmp_path)
    assert complaint in said
    assert (said == "") == (complaint == "")


@pytest.mark.usefixtures("images")
def test_the_cortex_m0_image_starts() -> None:
    """As it is, on the emulated board: no sensor there, but the main loop turns and the UART's interrupts answer."""
    elf = ROOT / "build" / "cortex-m0" / "selfcal.elf"
    board = ["-M", *TARGETS["cortex-m0"].board, "-display", "none", "-monitor", "none", "-serial", "stdio"]
    module = subprocess.Popen(
        ["qemu-system-arm", *board, "-kernel", str(elf)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert module.stdin is not None and module.stdout is not None
    try:
        time.sleep(1.0)  # bytes that come before the UART is on are lost
        module.stdin.write(b"V\rN\r\rO\rt1230\r")
        module.stdin.flush()
        assert module.stdout.read(15) == b"V0101\rNSCAL\r\r\r\a"
    finally:
        module.kill()
        module.communicate()


def flash(
    folder: Path, tools: tuple[str, ...], *arguments: str, **environment: str
) -> subprocess.CompletedProcess[str]:
    """tools/setup/flash.sh with programs of these names that print what they are called with."""
    for name in ("make", *tools):
        program = folder / name
        program.write_text('#!/bin/sh\necho "$(basename "$0") $*"\n')
        program.chmod(0o755)
    for name in ("sh", "basename"):
        (folder / name).symlink_to(f"/bin/{name}" if Path(f"/bin/{name}").exists() else f"/usr/bin/{name}")
    command = ["/bin/sh", str(ROOT / "tools" / "setup" / "flash.sh"), *arguments]
    env = {**os.environ, "PATH": str(folder), **environment}
    return subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("tools", "environment", "line"),
    [
        (("openocd", "st-flash"), {}, "openocd -f interface/stlink.cfg -f target/stm32f4x.cfg -c program "),
        (("st-flash", "dfu-util"), {}, "st-flash --reset write build/stm32f405/selfcal.bin 0x08000000"),
        (("dfu-util",), {}, "dfu-util -a 0 -s 0x08000000:leave -D build/stm32f405/selfcal.bin"),
        (("openocd", "dfu-util"), {"FLASHER": "dfu-util"}, "dfu-util -a 0"),
        (("st-flash",), {"SENSOR": "icm42688"}, "st-flash --reset write build/stm32f405-icm42688/selfcal.bin"),
    ],
)
def test_flash_takes_what_is_there(
    tools: tuple[str, ...], environment: dict[str, str], line: str, tmp_path: Path
) -> None:
    done = flash(tmp_path, tools, "stm32f405", **environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0] == "make --no-print-directory firmware"
    assert done.stdout.splitlines()[-1].startswith(line)


def test_flash_without_a_tool_or_a_target(tmp_path: Path) -> None:
    done = flash(tmp_path, (), "stm32f405")
    assert done.returncode == 1
    assert done.stderr == (
        "make flash: none of these is installed: openocd st-flash dfu-util (packages openocd, stlink-tools, dfu-util)\n"
    )


def test_flash_of_an_unknown_target(tmp_path: Path) -> None:
    done = flash(tmp_path, ("openocd",), "avr")
    assert done.returncode == 2
    boards = [line.split()[0] for line in (ROOT / "port/boards.txt").read_text().splitlines() if line[:1] not in "#"]
    assert done.stderr == f"make flash TARGET=..., one of: {' '.join(boards)}\n"
