"""The manifests of lib/: a consumer of each, built as its build system does.

CMake, pkg-config and PlatformIO build here. ESP-IDF, Zephyr and Arduino have stand-ins in tests/consumer/, which know
what lib/ asks of them, and their own validators where a package has one. Truth of each program: the bias that it
simulates, 0.5, within four of its own standard deviations. Programs of one compiler and one set of tables print alike.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import can
import pytest
import yaml

from selfcal.model.file import Model
from selfcal.verbs.codegen import codegen
from selfcal.wire import package_codegen
from selfcal.wire.frames import AxisReport, Decoder

from conftest import ROOT

LIBRARY, CONSUMER = ROOT / "lib", ROOT / "tests" / "consumer"
PROGRAM = LIBRARY / "examples" / "rest_c" / "rest.c"
AXES = list(Model.load(None).axes)
#: Releases that keep one interface: major.minor.
SERIES = package_codegen.version(LIBRARY).rpartition(".")[0]
#: The model of the tables of one's own: other axes, in another order, and another rate.
OWN_AXES, OWN_RATE = ("az", "gy"), 50.0
#: `pio`, but for the list of licences, which it would fetch.
PACK = """
import sys
from platformio.__main__ import main
from platformio.package.manifest.schema import ManifestSchema
ManifestSchema.load_spdx_licenses = staticmethod(lambda: {"licenses": [{"licenseId": "MIT"}]})
sys.exit(main())
"""
LINE = re.compile(r"^(?:(\w+): )?bias (-?[0-9.]+) \+- ([0-9.]+)$", re.MULTILINE)

TOOLS = ("platformio", "idf_component_tools", "kconfiglib", "SCons")
needs_tools = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in TOOLS),
    reason="PACKAGE TOOLS ABSENT: make setup-packages",
)


def call(*arguments: str | Path, cwd: Path | None = None, **environment: str) -> str:
    """Standard output of a command that succeeds."""
    done = subprocess.run(
        [str(argument) for argument in arguments],
        cwd=cwd, capture_output=True, text=True, check=False, env={**os.environ, **environment},
    )  # fmt: skip
    assert done.returncode == 0, (arguments, done.stdout[-3000:], done.stderr[-3000:])
    return done.stdout


def cmake(source: Path, build: Path, *options: str) -> None:
    """Configure and build; any warning of CMake is an error."""
    call("cmake", "-Werror=dev", "-GNinja", "-S", source, "-B", build, *options)
    call("cmake", "--build", build)


LOOP = LIBRARY / "examples" / "loop_c" / "loop.c"
LOOP_WARNINGS = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Wdouble-promotion", "-Werror"]


@pytest.mark.parametrize(
    "compiler",
    ["gcc -std=c99", "g++ -std=c++17 -x c++", "arm-none-eabi-gcc -std=c99 -mcpu=cortex-m4 -mthumb -Os"],
)
def test_the_loop_compiles(compiler: str) -> None:
    if shutil.which(compiler.split()[0]) is None:
        pytest.skip(f"{compiler.split()[0]} is missing: make setup-dev")
    folders = [f"-I{LIBRARY}", f"-I{LIBRARY / 'default'}"]
    call(*compiler.split(), *LOOP_WARNINGS, *folders, "-c", LOOP, "-o", os.devnull)


def test_the_loop_reports_sends_and_goes_on_after_a_power_cut(tables: Path, tmp_path: Path) -> None:
    """Twenty minutes with a report each, but for the first after power-on. Biases are those that it draws, 0.5: 4 sd.
    After the cut the bank goes on from the last save, at most 4 minutes old."""
    sources = [LOOP, tables / "selfcal_model.c", *sorted(LIBRARY.glob("*.c"))]
    compiler = ["cc", "-std=c99", "-O1", "-ffp-contract=off", f"-I{LIBRARY}", f"-I{tables}"]
    call(*compiler, *sources, "-lm", "-o", tmp_path / "loop")
    decoder = Decoder(from_start=True)
    reports: list[AxisReport] = []
    (tmp_path / "loop.log").write_text(call(tmp_path / "loop"))
    for frame in can.LogReader(tmp_path / "loop.log"):
        reports += decoder.feed(frame)
    assert all(report.complete for report in reports)
    assert decoder.statistics.refused + decoder.statistics.damaged == 0
    for axis in OWN_AXES:
        mine = [report for report in reports if report.axis == axis]
        assert len(mine) >= 16
        last = mine[-1]
        assert abs(last.value("bias_mean") - 0.5) < 4.0 * last.value("bias_sd")
        cut = next(k for k in range(1, len(mine)) if mine[k].time_s < mine[k - 1].time_s)
        before, after = mine[cut - 1].value("count"), mine[cut].value("count")
        assert 500.0 <= before < 600.0 and 420.0 <= after <= before + 70.0


def biases(printed: str) -> list[str]:
    """Names of the axes that a program reports, each bias at its truth."""
    found = LINE.findall(printed)
    assert len(found) == len(printed.splitlines()) > 0, printed
    for name, mean, sd in found:
        assert 0.0 < float(sd) < 0.01 or not name, printed
        assert abs(float(mean) - 0.5) < 4.0 * float(sd), printed
    return [name for name, _, _ in found]


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("product") / "my tables"
    codegen(None, folder, rate=OWN_RATE, axes=OWN_AXES)
    return folder


@pytest.fixture(scope="module")
def prefix(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where `cmake --install` has put lib/."""
    folder = tmp_path_factory.mktemp("installed")
    cmake(LIBRARY, folder / "build", f"-DCMAKE_INSTALL_PREFIX={folder / 'elsewhere'}")
    call("cmake", "--install", folder / "build", "--prefix", folder / "prefix")  # it may be moved
    return folder / "prefix"


def test_what_is_made_is_up_to_date(tmp_path: Path) -> None:
    """lib/default/, the versions and the licence are as `python -m selfcal.wire.package_codegen` writes them."""
    fresh = tmp_path / "lib"
    names = ["selfcal.h", *package_codegen.VERSIONS]
    fresh.mkdir()
    for name in names:
        text = (LIBRARY / name).read_text(encoding="utf-8")
        stale = text if name == "selfcal.h" else text.replace(package_codegen.version(LIBRARY), "77.8.9")
        (fresh / name).write_text(stale, encoding="utf-8")
    package_codegen.write(fresh)
    made = sorted(str(path.relative_to(fresh)) for path in fresh.rglob("*") if path.is_file())
    assert [name for name in made if name.startswith("default/")] == sorted(
        str(path.relative_to(LIBRARY)) for path in (LIBRARY / "default").iterdir()
    )
    for name in made:
        assert (fresh / name).read_bytes() == (LIBRARY / name).read_bytes(), name


def test_each_file_compiles_alone_with_the_default_tables() -> None:
    sources = sorted(LIBRARY.glob("*.c")) + sorted((LIBRARY / "default").glob("*.c"))
    strict = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fsyntax-only")
    call("cc", *strict, "-I", LIBRARY, "-I", LIBRARY / "default", *sources)


def test_find_package(prefix: Path, tables: Path, tmp_path: Path) -> None:
    """The default tables and those of one's own side by side, from a folder that the installation was moved to."""
    cmake(
        CONSUMER / "cmake", tmp_path, "-DWAY=find_package", f"-DCMAKE_PREFIX_PATH={prefix}", f"-DTABLES={tables}",
        f"-DPROGRAM={PROGRAM}", f"-DASKED={SERIES}",
    )  # fmt: skip
    assert biases(call(tmp_path / "product")) == AXES
    assert biases(call(tmp_path / "own_product")) == list(OWN_AXES)
    refused = subprocess.run(
        ["cmake", "-GNinja", "-S", ".", "-B", "b", f"-DCMAKE_PREFIX_PATH={prefix}"],
        cwd=_project(tmp_path / "newer", f"find_package(selfcal {SERIES.split('.')[0]}.999 REQUIRED)"),
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert refused.returncode != 0 and "compatible with requested version" in refused.stderr


def _project(folder: Path, *lines: str, languages: str = "C") -> Path:
    folder.mkdir()
    head = ("cmake_minimum_required(VERSION 3.17)", f"project(product {languages})")
    (folder / "CMakeLists.txt").write_text("\n".join([*head, *lines, ""]), encoding="utf-8")
    return folder


def test_fetch_content(tmp_path: Path) -> None:
    """FetchContent calls add_subdirectory; the test for ARM takes that by itself. A subproject installs nothing."""
    given = (f"-DLIBRARY={LIBRARY}", f"-DPROGRAM={PROGRAM}")
    cmake(CONSUMER / "cmake", tmp_path, "-DWAY=FetchContent", *given)
    assert biases(call(tmp_path / "product")) == AXES
    call("cmake", "--install", tmp_path, "--prefix", tmp_path / "prefix")
    assert not (tmp_path / "prefix").exists()


@pytest.mark.parametrize(
    ("cpu", "core", "way", "attributes"),
    [
        ("cortex-m4", "cortex-m4f", "find_package", ("v7E-M", "VFP registers")),
        ("cortex-m0", "cortex-m0", "add_subdirectory", ("v6S-M",)),
    ],
)
def test_the_toolchain_file(
    cpu: str, core: str, way: str, attributes: tuple[str, ...], prefix: Path, tmp_path: Path
) -> None:
    """A program for the part, with tables for the part: on the M0 in integers. Truth: the ABI's attributes."""
    codegen(None, tmp_path / "tables", target=core)
    toolchain = prefix / "share" / "selfcal" / "cmake" / "arm-none-eabi.cmake"
    cmake(
        CONSUMER / "cmake", tmp_path / "build", f"-DCMAKE_TOOLCHAIN_FILE={toolchain}", f"-DSELFCAL_CPU={cpu}",
        "-DCMAKE_EXE_LINKER_FLAGS=--specs=nosys.specs", f"-DWAY={way}",
        f"-DCMAKE_PREFIX_PATH={prefix}", f"-DLIBRARY={LIBRARY}", f"-DTABLES={tmp_path / 'tables'}", "-DOWN_ALONE=ON",
        f"-DPROGRAM={PROGRAM}", f"-DASKED={SERIES}",
    )  # fmt: skip
    image = tmp_path / "build" / "own_product"
    shown = call("arm-none-eabi-readelf", "-A", image)
    assert all(f": {attribute}" in shown for attribute in attributes), shown
    assert ("VFP" in shown) == (core == "cortex-m4f")
    integers = " T selfcal_scale" in call("arm-none-eabi-nm", tmp_path / "build" / "libown.a")
    assert integers == (core == "cortex-m0")


def test_cmake_names_the_next_step(tmp_path: Path) -> None:
    """A folder without tables, and a project without C."""
    include = f'include("{LIBRARY}/cmake/selfcal.cmake")'
    for name, languages, lines, words in (
        ("empty", "C", (include, "selfcal_add_library(own tables)"), "`selfcal codegen MODEL.yaml -o"),
        ("other", "NONE", (include, "selfcal_add_library(own)"), r"project(... LANGUAGES C)"),
    ):
        folder = _project(tmp_path / name, *lines, languages=languages)
        done = subprocess.run(
            ["cmake", "-GNinja", "-S", folder, "-B", folder / "b"], capture_output=True, text=True, check=False
        )
        assert done.returncode != 0 and words in " ".join(done.stderr.split()), done.stderr


def test_pkg_config(prefix: Path, tables: Path, tmp_path: Path) -> None:
    """The archive with the default tables, and the sources with tables of one's own, as lib/README.md prints."""
    (description,) = prefix.rglob("selfcal.pc")
    environment = {"PKG_CONFIG_PATH": str(description.parent)}
    assert call("pkg-config", "--modversion", "selfcal", **environment).strip() == package_codegen.version(LIBRARY)
    by_archive = f"cc -std=c99 $(pkg-config --cflags selfcal) {PROGRAM} $(pkg-config --libs selfcal) -o product"
    call("sh", "-ec", by_archive, cwd=tmp_path, **environment)
    assert biases(call(tmp_path / "product")) == AXES
    (tmp_path / "tables").symlink_to(tables)
    shutil.copyfile(PROGRAM, tmp_path / "product.c")
    printed = re.search(r"```sh\n(cc [^`]*pkg-config --variable=sources[^`]*)```", (LIBRARY / "README.md").read_text())
    assert printed is not None
    call("sh", "-ec", printed[1].replace("-O2", "-O0"), cwd=tmp_path, **environment)
    assert biases(call(tmp_path / "product")) == list(OWN_AXES)


def test_esp_idf(tables: Path, tmp_path: Path) -> None:
    """lib/CMakeLists.txt as a component, by a stand-in."""
    given = (f"-DLIBRARY={LIBRARY}", f"-DPROGRAM={PROGRAM}", f"-DTABLES={tables}")
    cmake(CONSUMER / "esp_idf", tmp_path, *given)
    assert biases(call(tmp_path / "product")) == list(OWN_AXES)
    # ESP-IDF reads a component's requirements from a script first, without the project's variables.
    script = tmp_path / "early.cmake"
    script.write_text(
        f"set(ESP_PLATFORM 1)\nmacro(idf_component_register)\n  message(STATUS registered)\n  return()\nendmacro()\n"
        f'include("{LIBRARY}/CMakeLists.txt")\n',
        encoding="utf-8",
    )
    assert "registered" in call("cmake", "-P", script)


def test_zephyr(tables: Path, tmp_path: Path) -> None:
    """The module by a stand-in, its tables relative to the application's folder."""
    module = yaml.safe_load((LIBRARY / "zephyr" / "module.yml").read_text(encoding="utf-8"))
    assert (LIBRARY / module["build"]["cmake"] / "CMakeLists.txt").is_file()
    assert (LIBRARY / module["build"]["kconfig"]).is_file()
    given = (f"-DAPPLICATION={tables.parent}", f"-DLIBRARY={LIBRARY}", f"-DPROGRAM={PROGRAM}")
    cmake(CONSUMER / "zephyr", tmp_path, *given, f"-DTABLES={tables.name}")
    assert biases(call(tmp_path / "product")) == list(OWN_AXES)


def sketch(name: str, tables: Path, folder: Path) -> str:
    """What a sketch prints in ten minutes, built by Arduino's flat layout: files at the top of a library's folder are
    compiled, each with the tops of the libraries as places of headers; a sketch is C++."""
    libraries = folder / "libraries"
    shutil.copytree(LIBRARY, libraries / "selfcal", ignore=shutil.ignore_patterns("utility"))
    shutil.copytree(tables, libraries / "selfcal_tables")
    shutil.copyfile(LIBRARY / "examples" / name / f"{name}.ino", folder / "sketch.cpp")
    sources = [*sorted((libraries / "selfcal").glob("*.c")), *sorted((libraries / "selfcal_tables").glob("*.c"))]
    places = ("-I", libraries / "selfcal", "-I", libraries / "selfcal_tables")
    (folder / "objects").mkdir()
    call("cc", "-std=gnu11", "-c", *places, *sources, cwd=folder / "objects")
    objects = sorted((folder / "objects").iterdir())
    call(
        "c++", "-std=gnu++17", "-Wall", "-Wextra", *places, "-I", CONSUMER / "arduino", "-I", folder,
        CONSUMER / "arduino" / "main.cpp", *objects, "-lm", "-o", folder / "sketch",
    )  # fmt: skip
    return call(folder / "sketch")


def test_an_mpu6050_prints_its_data_sheet(tmp_path: Path) -> None:
    """Truth: the noise and the bias of the sensor on the stand-in's bus (Wire.h), at 100 Hz: N = sd / 10 in 60 times
    deg/s or m/s^2. The last minute's numbers within 4.5 sd: twelve of them, and rounding adds 0.3 % to N."""
    codegen("mpu6050", tmp_path / "tables", rate=100.0, target="cortex-m4f")
    lines = sketch("mpu6050", tmp_path / "tables", tmp_path).splitlines()
    assert len(lines) == 60
    mean, sd = (196.5, -655.0, 40.0, 0.0, 120.0, 16384.0), (6.0, 6.0, 6.0, 40.0, 40.0, 40.0)
    for k, line in enumerate(lines[-6:]):
        unit = 1.0 / 131.0 if k < 3 else 9.80665 / 16384.0
        found = re.fullmatch(
            r"(\w\w): [AV]RW (\S+) \[(\S+), (\S+)\] \S+, RRW [^,]+(?:, [^,]+)?, bias (\S+) \+- (\S+) (deg/s|m/s\^2)",
            line,
        )
        assert found is not None and found[1] == ("gx", "gy", "gz", "ax", "ay", "az")[k], line
        middle, low, high, bias, of_bias = map(float, found.groups()[1:6])
        assert abs(math.log(middle / (6.0 * sd[k] * unit))) < 4.5 * math.log(high / low) / 3.29 + 0.003, line
        assert abs(bias - mean[k] * unit) < 4.5 * of_bias, line


def test_arduino(tmp_path: Path) -> None:
    """Truth: the bias that the sketch simulates, once a minute."""
    assert len(biases(sketch("rest", LIBRARY / "default", tmp_path))) == 10
    properties = dict(
        line.split("=", 1) for line in (LIBRARY / "library.properties").read_text(encoding="utf-8").splitlines()
    )
    required = {"name", "version", "author", "maintainer", "sentence", "paragraph", "category", "url", "architectures"}
    assert required <= properties.keys()
    assert (LIBRARY / properties["includes"]).exists() or (LIBRARY / "default" / properties["includes"]).exists()


@needs_tools
def test_platformio(tables: Path, tmp_path: Path) -> None:
    """`pio pkg pack`, then `pio run` of a project that takes the unpacked library, with either tables."""
    archive = tmp_path / "selfcal.tar.gz"
    pio = (sys.executable, "-m", "platformio")
    core = {
        "PLATFORMIO_CORE_DIR": str(tmp_path / "core"),
        "PLATFORMIO_SETTING_ENABLE_TELEMETRY": "no",
        "PLATFORMIO_SETTING_CHECK_PLATFORMIO_INTERVAL": "9999",
    }
    call(sys.executable, "-c", PACK, "pkg", "pack", "-o", archive, LIBRARY, **core)
    with tarfile.open(archive) as packed:
        packed.extractall(tmp_path / "selfcal", filter="data")
    manifest = json.loads((tmp_path / "selfcal" / "library.json").read_text(encoding="utf-8"))
    for example in manifest["examples"]:
        assert all((tmp_path / "selfcal" / example["base"] / name).is_file() for name in example["files"])
    _scons(tmp_path / "core")
    for name, option, axes in (("default", "", AXES), ("own", "custom_selfcal_tables = my tables", OWN_AXES)):
        project = tmp_path / name
        (project / "src").mkdir(parents=True)
        shutil.copyfile(PROGRAM, project / "src" / "main.c")
        shutil.copytree(tables, project / "my tables")
        lines = (
            "[env:host]",
            f"platform = symlink://{CONSUMER / 'platformio'}",
            f"lib_deps = symlink://{tmp_path / 'selfcal'}",
        )
        (project / "platformio.ini").write_text("\n".join([*lines, option, ""]), encoding="utf-8")
        call(*pio, "run", "-d", project, **core)
        assert biases(call(project / ".pio" / "build" / "host" / "program")) == list(axes), name


def _scons(core: Path) -> None:
    """PlatformIO's package `tool-scons`, from the SCons of this environment: the registry's cannot be fetched."""
    from platformio.dependencies import get_core_dependencies

    folder = core / "packages" / "tool-scons"
    folder.mkdir(parents=True)
    version = get_core_dependencies()["tool-scons"].lstrip("~")
    (folder / "scons.py").write_text("import SCons.Script\n\nSCons.Script.main()\n", encoding="utf-8")
    identity = {"name": "tool-scons", "version": version}
    (folder / "package.json").write_text(json.dumps(identity), encoding="utf-8")
    spec = {"owner": "platformio", "id": 8192, "name": "tool-scons", "requirements": None, "uri": None}
    (folder / ".piopm").write_text(json.dumps({"type": "tool", "spec": spec, **identity}), encoding="utf-8")


@needs_tools
def test_espressif_packs_the_component(tmp_path: Path) -> None:
    """The manifest by Espressif's own validator, as at an upload, and the archive."""
    shutil.copytree(LIBRARY, tmp_path / "selfcal")
    compote = Path(sys.executable).with_name("compote")
    call(compote, "component", "pack", "--project-dir", tmp_path / "selfcal", "--name", "selfcal",
         "--dest-dir", tmp_path / "dist", IDF_COMPONENT_CHECK_NEW_VERSION="0")  # fmt: skip
    (archive,) = (tmp_path / "dist").glob("*.tgz")
    with tarfile.open(archive) as packed:
        names = {Path(name).as_posix().removeprefix("./") for name in packed.getnames()}
    assert {"CMakeLists.txt", "cmake/selfcal.cmake", "default/selfcal_model.c", "LICENSE", "bank.c"} <= names
    assert package_codegen.version(LIBRARY) in archive.name


@needs_tools
def test_zephyr_configures(monkeypatch: pytest.MonkeyPatch) -> None:
    """The Kconfig by kconfiglib, which Zephyr's own is made from: no warning, and the folder of the tables."""
    import kconfiglib

    monkeypatch.setenv("LIBRARY", str(LIBRARY))
    config = kconfiglib.Kconfig(str(CONSUMER / "zephyr" / "Kconfig"), warn_to_stderr=False)
    assert config.warnings == []
    assert config.syms["SELFCAL"].str_value == "n" and config.syms["SELFCAL_TABLES"].visibility == 0
    config.syms["SELFCAL"].set_value(2)
    assert config.syms["REQUIRES_FULL_LIBC"].str_value == "y"
    config.syms["SELFCAL_TABLES"].set_value("tables")
    assert config.syms["SELFCAL_TABLES"].str_value == "tables"
