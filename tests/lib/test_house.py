"""House rules that are counted (tests/count_house.py), and the library as a product takes it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import count_house
import pytest

from selfcal.verbs.codegen import codegen

from conftest import ROOT

USER = """#include "selfcal_model.h"
#include <cstdio>
static double memory[SELFCAL_MODEL_BYTES / sizeof(double) + 1U];
static selfcal_t bank;
static selfcal_work_t work;
static selfcal_report_t report;
int main() {
    if (selfcal_init(&bank, &selfcal_model, memory, sizeof memory) != SELFCAL_OK) return 1;
    for (unsigned i = 0; i < 100U * selfcal_model.block; i++) {
        float sample[SELFCAL_MODEL_AXES];
        for (unsigned axis = 0; axis < SELFCAL_MODEL_AXES; axis++)
            sample[axis] = 0.01F * float((i * 7919U + axis) % 101U);
        if (selfcal_push(&bank, sample) != SELFCAL_OK) return 2;
    }
    if (selfcal_report(&work, &bank, 0, &report) != SELFCAL_OK) return 3;
    std::printf("%g\\n", static_cast<double>(report.bias_mean));
    return 0;
}
"""


def test_no_rule_is_broken() -> None:
    assert count_house.complaints() == []


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("static int f(int a) {\n    return a;\n}\n", [("f", True, 3)]),
        ("selfcal_status_t g(int a,\n                   int b)\n{\n}\n", [("g", False, 4)]),
        ("static const part_t *h(void) {\n}\n", [("h", True, 2)]),
        ("int declared(int a);\n", []),
    ],
)
def test_functions_are_found(text: str, found: list[tuple[str, bool, int]]) -> None:
    assert count_house.functions(text) == found


def test_a_circle_is_found() -> None:
    assert count_house.circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
    assert count_house.circle({"a": {"b", "c"}, "b": {"c"}}) == []


def test_a_file_and_the_header_of_its_name_are_one() -> None:
    """A stage takes a type from the header of the file that calls it: no function is called back, yet it is a circle.
    With that header under a name of its own there is none."""
    stage = "int stage(void) {\n    return 0;\n}\n"
    whole = "int whole(void) {\n    return stage();\n}\n"
    texts = {"whole.h": "", "stage.c": '#include "whole.h"\n' + stage, "whole.c": '#include "whole.h"\n' + whole}
    assert count_house.circle(count_house.uses(texts)) == ["stage", "whole", "stage"]
    below = {name.replace("whole.h", "below.h"): text.replace("whole.h", "below.h") for name, text in texts.items()}
    assert count_house.circle(count_house.uses(below)) == []


@pytest.fixture
def product(tmp_path: Path) -> Path:
    """A folder with the library and the generated files, as a product copies them."""
    for path in (ROOT / "lib").glob("*.[ch]"):
        shutil.copy(path, tmp_path)
    codegen(None, tmp_path, rate=100.0)
    return tmp_path


@pytest.mark.parametrize("target", ["host", "cortex-m4f", "cortex-m0"])
def test_the_library_compiles_in_an_empty_folder(product: Path, target: str) -> None:
    """With the generated sizes, and nothing on the command line; without a warning."""
    codegen(None, product, rate=100.0, target=target)
    sources = sorted(path.name for path in product.glob("*.c"))
    command = ["cc", "-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-c", *sources]
    done = subprocess.run(command, cwd=product, check=True, capture_output=True, text=True)
    assert done.stderr == ""


def test_a_user_in_cpp17(product: Path) -> None:
    """The mean of the samples 0 to 1 is 0.5."""
    (product / "user.cpp").write_text(USER)
    sources = sorted(path.name for path in product.glob("*.c"))
    subprocess.run(["cc", "-std=c99", "-O1", "-c", *sources], cwd=product, check=True)
    objects = sorted(path.name for path in product.glob("*.o"))
    flags = ["-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    subprocess.run(["c++", *flags, "user.cpp", *objects, "-lm", "-o", "user"], cwd=product, check=True)
    told = subprocess.run([product / "user"], check=True, capture_output=True, text=True).stdout
    assert float(told) == pytest.approx(0.5, abs=0.02)


PIPE = """#include "selfcal_model.h"
static double memory[SELFCAL_MODEL_IMU_BYTES / sizeof(double) + 1U];
static selfcal_imu_t imu;
int main(void) {
    float reading[SELFCAL_MODEL_AXES] = {0.0F};
    if (selfcal_imu_init(&imu, &selfcal_model_pipe, memory, sizeof memory) != SELFCAL_OK) return 1;
    return (int)selfcal_imu_sample(&imu, reading, 0, 0);
}
"""
OPTIONAL = {"selfcal_gate_push", "selfcal_adequacy_push", "selfcal_changes_handle", "selfcal_form"}


def test_only_what_is_named_is_linked(product: Path) -> None:
    """The bank alone, the pipe of a model with a gate, and the same without a judgement: by nm."""
    (product / "pipe.c").write_text(PIPE)
    (product / "bank.c_").write_text(USER)
    sections = ["-std=c99", "-O1", "-ffunction-sections", "-fdata-sections"]
    sources = [path.name for path in sorted(product.glob("*.c")) if path.name not in ("pipe.c", "selfcal_model.c")]
    subprocess.run(["cc", *sections, "-c", *sources], cwd=product, check=True)
    objects = [f"{Path(name).stem}.o" for name in sources]
    for program, flag, named in (
        (["-x", "c++", "bank.c_"], "", set()),
        (["pipe.c"], "", {"selfcal_gate_push", "selfcal_adequacy_push"}),
        (["pipe.c"], "-DSELFCAL_MODEL_JUDGED=0", {"selfcal_gate_push"}),
    ):
        flags = [flag] if flag else []
        subprocess.run(["cc", *sections, *flags, "-c", "selfcal_model.c"], cwd=product, check=True)
        linked = ["-x", "none", *objects, "selfcal_model.o", "-Wl,--gc-sections", "-lm", "-lstdc++", "-o", "program"]
        subprocess.run(["cc", "-O1", *flags, *program, *linked], cwd=product, check=True)
        symbols = subprocess.run(["nm", "program"], cwd=product, check=True, capture_output=True, text=True).stdout
        assert OPTIONAL & {line.split()[-1] for line in symbols.splitlines()} == named
