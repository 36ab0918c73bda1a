"""The command: every fault of the user is one line on stderr and exit code 2, whatever raised it."""

import inspect
import json
import os
import re
import signal
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import typer

import selfcal
from selfcal import cli
from selfcal.logs.loaders import READ, Reading

from conftest import CALLED, COMMAND, ROOT, run

NO_FOLDER = "no/out.json: cannot be written: there is no folder 'no'; make it first"
DEFAULT = ROOT / "tools" / "selfcal" / "model" / "models" / "default.yaml"


def one_error(*arguments: str | Path, cwd: Path | None = None) -> str:
    """The one line of a run that must fail as the contract says."""
    done = run(*arguments, cwd=cwd)
    assert done.returncode == 2, done
    assert done.stdout == ""
    assert re.fullmatch(r"selfcal: error: [^\n]+\n", done.stderr), done.stderr
    return done.stderr.removeprefix("selfcal: error: ").rstrip()


def test_version_is_the_headers() -> None:
    header = (ROOT / "lib" / "selfcal.h").read_text(encoding="utf-8")
    version = re.search(r'^#define SELFCAL_VERSION "(.*)"', header, re.MULTILINE)
    assert version is not None
    assert run("--version").stdout == f"selfcal {version[1]}\n"
    assert selfcal.__version__ == version[1]


def test_help() -> None:
    done = run("--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert run().stdout == done.stdout
    for verb in selfcal.VERBS:
        assert re.search(rf"^  {verb} ", done.stdout, re.MULTILINE)
        assert run(verb, "--help").returncode == 0


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_can_be_installed(shell: str, tmp_path: Path) -> None:
    """Into the user's own files, from within that shell; and the shell is then told the verbs."""
    home = os.environ | {"HOME": str(tmp_path), "SHELL": f"/bin/{shell}"}
    install = [*COMMAND, "--install-completion", shell]
    done = subprocess.run(install, capture_output=True, text=True, env=home, check=False)
    assert done.returncode == 0, done.stderr
    assert [path for path in tmp_path.rglob("*") if path.is_file() and "SELFCAL_COMPLETE" in path.read_text()]
    if shell == "bash":
        asked = home | {"_SELFCAL_COMPLETE": "complete_bash", "COMP_WORDS": "selfcal id", "COMP_CWORD": "1"}
        done = subprocess.run(COMMAND, capture_output=True, text=True, env=asked, check=False)
        assert done.stdout.split() == ["identify"]


def test_help_loads_nothing_heavy() -> None:
    code = "import sys, selfcal.cli; print(sorted({'numpy', 'scipy', 'can', 'matplotlib', 'yaml'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_identify_loads_no_scipy_optimize() -> None:
    """Without regressors, whose mixtures need it: its import takes longer than all else at the start. The check of the
    Allan deviation takes scipy.special and scipy.fft, which load in a tenth of that."""
    log = ROOT / "tests" / "data" / "simulated_adis16405.npz"
    code = f"import sys, selfcal; selfcal.identify({str(log)!r}, axes=['gx']); print('scipy.optimize' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_verbs_are_functions() -> None:
    """The command's verbs are the files, and no module has the name of one: that would hide the function."""
    listed = set(re.findall(r"^  ([a-z]+) ", run("--help").stdout.partition("Commands:")[2], re.MULTILINE))
    assert listed == selfcal.VERBS.keys()
    folder = Path(selfcal.__file__).parent
    for verb in selfcal.VERBS:
        assert callable(getattr(selfcal, verb))
        assert not (folder / verb).exists() and not (folder / f"{verb}.py").exists()
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = selfcal.nonsense


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["nonsense"], "No such command 'nonsense'; see `selfcal --help`"),
        (
            ["identify"],
            f"Missing argument 'LOG...' (Recording: {READ}; several files are joined by their time stamps); see "
            "`selfcal identify --help`",
        ),
        (["identify", "."], ".: is a folder: name a recording in it (.csv, "),
        (["identify", "log.csv", "--engine", "gpu"], "Invalid value for '--engine': 'gpu' is not one of 'library', "),
        (["identify", "log.csv", "--json", "no/out.json"], NO_FOLDER),
        (["identify", "log.csv", "--json", "."], ".: cannot be written: it is a folder; give a file name"),
        (["identify", "log.csv", "--plot", "out.xls"], "out.xls: a plot is one of .png, .pdf, .svg, .jpg"),
        (["identify", "log.csv", "--overbound", "0.9"], "--overbound is for --export FORMAT FILE"),
        (["identify", "log.csv", "--units", "metric"], "Invalid value for '--units': 'metric' is not "),
        (["montecarlo", "--json", "no/out.json"], NO_FOLDER),
        (["simulate", "m.yaml", "-o", "log.csv", "--seed", "abc"], "Invalid value for '--seed': must be a whole"),
        (["identify", "log.csv", "--rate", "fast"], "Invalid value for '--rate'"),
        (["identify", "log.csv", "--engine", "steam"], "Invalid value for '--engine'"),
        (["identify", "log.csv", "--unit", "rad/s"], "--unit takes NAME=VALUE, not 'rad/s'"),
        (["identify", "log.csv", "--column", "gx=a", "--column", "gx=b"], "--column: 'gx' is given twice"),
        (["identify", "log.csv", "--scale", "big"], "--scale takes [NAME=]SIZE, a unit in brackets after it (gx="),
        (["identify", "absent.csv"], "absent.csv: cannot be read: No such file or directory"),
        (["replay", "absent.csv"], "absent.csv: cannot be read: No such file or directory"),
        (["identify", "log.csv", "--model", "absent.yaml"], "absent.yaml: "),
        (["simulate", "absent.yaml", "-o", "log.csv"], "absent.yaml: "),
        (["codegen", "absent.yaml", "-o", "."], "absent.yaml: "),
        (["monitor"], "which module? --channel names its port (th"),
        (["monitor", "--channel", "/dev/absent"], ""),
    ],
)
def test_faults_are_one_line(tmp_path: Path, arguments: list[str], expected: str) -> None:
    (tmp_path / "log.csv").write_text("t[s],gx[deg/s]\n0,1\n1,2\n2,1\n3,2\n")
    assert one_error(*arguments, cwd=tmp_path).startswith(expected.replace("`selfcal", f"`{CALLED}"))


@pytest.mark.parametrize(
    ("rate", "said"),
    [
        ("100", "100 samples at 100 Hz make a bank sample of 1 s"),
        ("819.2", "819 samples at 819.2 Hz make a bank sample of 0.9997559 s"),
        ("0.5", "1 sample at 0.5 Hz makes a bank sample of 2 s"),
    ],
)
def test_codegen_says_what_its_tables_assume(rate: str, said: str, tmp_path: Path) -> None:
    """And its header has the rate for the preprocessor to check. (819 samples are 819/819.2 s.)"""
    done = run("codegen", str(DEFAULT), "-o", "made", "--rate", rate, cwd=tmp_path)
    assert done.returncode == 0
    assert done.stdout == f"made: {said}\n"
    header = (tmp_path / "made" / "selfcal_model.h").read_text()
    assert f"#define SELFCAL_MODEL_RATE_MILLIHZ {float(rate) * 1000:.0f}UL" in header


@pytest.mark.parametrize("rate", ["0", "-1", "nan", "1e9"])
def test_codegen_of_no_rate(rate: str, tmp_path: Path) -> None:
    said = one_error("codegen", str(DEFAULT), "-o", "made", "--rate", rate, cwd=tmp_path)
    assert f"the sampling rate, {float(rate):g} Hz, is outside 1e-06 to 1e+06 Hz" in said
    assert not (tmp_path / "made").exists()


def test_json_on_stdout_is_nothing_else(tmp_path: Path) -> None:
    """A program reads stdout; the tables go to stderr."""
    (tmp_path / "log.csv").write_text("t[s],gx[deg/s]\n" + "".join(f"{k},{0.1 * (k * 7 % 5)}\n" for k in range(60)))
    for verb in (["identify", "log.csv"], ["montecarlo", "--records", "2", "--duration", "20"]):
        done = run(*verb, "--json", "-", cwd=tmp_path)
        assert done.returncode == 0, done
        assert json.loads(done.stdout)["schema"] == f"selfcal.{verb[0]}/1"
        assert "─" in done.stderr
        assert run(*verb, cwd=tmp_path).stdout.count("─") > 20


def test_a_gate_that_codegen_leaves_out_is_named(tmp_path: Path) -> None:
    """It works on windows of two samples or more within a bank interval."""
    text = DEFAULT.read_text()
    complaint = "model.yaml: `gate` is left out: a bank interval is one sample"
    for bank_hz, said, gate in ((819.2, complaint, 0), (409.6, "", 1)):
        (tmp_path / "model.yaml").write_text(text.replace("bank_rate_hz: 1.0", f"bank_rate_hz: {bank_hz}"))
        done = run("codegen", "model.yaml", "-o", "made", cwd=tmp_path)
        assert done.returncode == 0
        assert done.stderr.startswith(said)
        assert done.stderr.count("\n") == 1 - gate
        assert f"#define SELFCAL_MODEL_GATE {gate}\n" in (tmp_path / "made" / "selfcal_model.h").read_text()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: " + 3000 * "[", "model.yaml: not a model file: nested too deep"),
        ("a: [", "model.yaml: line 1: not valid YAML"),
        ("[]", "model.yaml: not a model file"),
    ],
    ids=["deep", "open", "list"],
)
def test_what_is_no_model_file(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "model.yaml").write_text(text)
    assert one_error("codegen", "model.yaml", "-o", "made", cwd=tmp_path).startswith(said)


BAD = {
    "empty": ("", "bad.csv: the file is empty"),
    "header only": ("t[s],gx[deg/s]\n", "bad.csv: line 1: there is a header but no rows"),
    "text cell": ("t[s],gx[deg/s]\n0,1\n1,x\n", "bad.csv: line 3: column 'gx': 'x' is not a number"),
    "no stamp": ("t[s],gx[deg/s]\n0,1\n,2\n", "bad.csv: line 3: column 't': no time stamp (an empty cell or NaN)"),
    "infinity": ("t[s],gx[deg/s]\n0,1\n1,inf\n", "bad.csv: line 3: column 'gx': infinite"),
    "time backwards": ("t[s],gx[deg/s]\n0,1\n-1,2\n", "bad.csv: line 3: column 't': time runs backwards"),
    "missing unit": ("t[s],gx\n0,1\n1,2\n", "bad.csv: line 1: column 'gx' has no unit"),
    "unknown unit": ("t[s],gx[rpn]\n0,1\n1,2\n", "bad.csv: line 1: column 'gx' has the unknown unit 'rpn'"),
    "ragged row": ("t[s],gx[deg/s]\n0,1\n1\n", "bad.csv: line 3: 1 cells where the header has 2"),
    "binary junk": ("\0\x01\x02", "bad.csv: line 1: not text (byte 0x00)"),
    "one row": ("t[s],gx[deg/s]\n0,1\n", "bad.csv: line 2: one row only"),
    "duplicate column": ("gx[deg/s],gx[deg/s]\n0,1\n1,2\n", "bad.csv: line 1: column 'gx' appears twice"),
}


@pytest.mark.parametrize("verb", ["identify", "replay"])
@pytest.mark.parametrize(("text", "expected"), BAD.values(), ids=BAD)
def test_bad_recordings(tmp_path: Path, verb: str, text: str, expected: str) -> None:
    """The step's list; every other kind is in test_recording.py."""
    (tmp_path / "bad.csv").write_text(text)
    assert one_error(verb, "bad.csv", cwd=tmp_path).startswith(expected)


@pytest.mark.parametrize("verb", ["identify", "diagnose", "compare", "convert", "replay", "monitor", "rivals", "worth"])
def test_keywords_differ_from_options_by_the_rules_of_the_readme(verb: str) -> None:
    """Truth: the table in tools/pages/python.md. A monitor's `start` is its `--from`."""
    named = {"start": "start_s", "end": "end_s", "since_power_on": "since_power_on_s", "axis": "axes"}
    named |= {"column": "columns", "unit": "units", "source": "sources", "from": "start", "no_suspicion": "suspicion"}
    function = getattr(import_module(f"selfcal.verbs.{verb}"), verb)
    keywords = set(inspect.signature(function).parameters)
    if "reading" in keywords:
        keywords |= Reading.__annotations__.keys()
    command = typer.main.get_command(cli.app)
    assert isinstance(command, typer.core.TyperGroup)
    options = {
        max(one.opts, key=len).strip("-").replace("-", "_")
        for one in command.get_command(None, verb).params
        if one.param_type_name == "option"
    }
    known = {named.get(option, option) for option in options - {"help"}}
    assert known <= keywords, known - keywords


def test_an_option_that_takes_one_value_is_not_given_twice() -> None:
    """The first would be lost: two exports, two recordings to measure the gain on."""
    said = one_error("identify", "log.csv", "--export", "px4", "a", "--export", "vins", "b")
    assert said == "--export is given 2 times; it takes one value: run once for each"
    assert one_error("diagnose", "log.csv", "--on=a.csv", "--on", "b.csv").startswith("--on is given 2 times")
    assert "cannot" in one_error("identify", "no-such.csv", "--axis", "gx", "--axis", "gy")


def test_compare_reads_foreign_headers(tmp_path: Path) -> None:
    """Truth: N of the two logs, 0.04 and 0.05 deg/s/sqrt(Hz), 2000 samples at 1 Hz: 10 sd apart."""
    draw = np.random.default_rng(88)
    for name, sigma in (("a.csv", 0.04), ("b.csv", 0.05)):
        np.savetxt(tmp_path / name, sigma * draw.standard_normal(2000), header="turn", comments="")
    reading = ("--column", "gx=turn", "--unit", "gx=deg/s", "--rate", "1")
    done = run("compare", "a.csv", "b.csv", *reading, "--fail-on", "changed", "--json", "c.json", cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    [change] = [one for one in json.loads((tmp_path / "c.json").read_text())["axes"]["gx"] if one["quantity"] == "N"]
    assert abs(change["before"] / 0.04 - 1.0) < 0.1
    assert abs(change["after"] / 0.05 - 1.0) < 0.1


def test_interrupt_is_clean() -> None:
    """Ctrl-C while a verb waits for a module that never speaks."""
    master, slave = os.openpty()
    try:
        command = [*COMMAND, "monitor", "--channel", os.ttyname(slave)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            os.read(master, 1)  # python-can opens the channel: the verb runs
            time.sleep(0.5)
            process.send_signal(signal.SIGINT)
            try:
                _, errors = process.communicate(timeout=30)
            finally:
                process.kill()
    finally:
        os.close(master)
        os.close(slave)
    assert process.returncode in (0, 130)
    assert "Traceback" not in errors


def test_an_import_that_swallows_everything_swallows_no_end(tmp_path: Path) -> None:
    """A library tries its parts by a bare `except`: a signal that comes then ends the process as soon as it is done."""
    (tmp_path / "swallows.py").write_text(
        "import os, signal\ntry:\n    os.kill(os.getpid(), signal.SIGTERM)\n    import email.mime\nexcept:\n    pass\n"
    )
    program = (
        "import sys, time\nfrom selfcal.base.ending import Ended, install_signals, last_signal\n"
        f"install_signals()\nsys.path.insert(0, {str(tmp_path)!r})\n"
        "try:\n    import swallows\n    time.sleep(30)\nexcept Ended:\n    sys.exit(last_signal())\n"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False, timeout=20).returncode == 128 + signal.SIGTERM
