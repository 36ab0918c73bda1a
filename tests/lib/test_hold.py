"""Reports on a copy of an axis's sums (lib/imu_hold.c), by builds that the C tests do not have: sums of terms,
regressors, integers. And a program that was compiled with other sizes than the library.

The truth is the report on the bank itself. With the same samples in the sums both must agree in every bit."""

import subprocess
from pathlib import Path

import pytest

from selfcal.model.file import Model
from selfcal.model.tables import make_tables
from selfcal.wire.c_tables import write_tables

from conftest import ROOT

RATE_HZ = 5.0

PROGRAM = """#include "selfcal_model.h"
#include <stdio.h>
static selfcal_imu_t imu;
static selfcal_kept_t kept;
static double memory[(SELFCAL_MODEL_IMU_BYTES + 7U) / 8U];
int main(void) {
    float reading[SELFCAL_MODEL_AXES];
    unsigned seed = 9U;
    if (selfcal_imu_init(&imu, &selfcal_model_pipe, memory, sizeof memory) != SELFCAL_OK) return 1;
    selfcal_imu_keep(&imu, &kept);
    for (int n = 0; n < 2003; n++) {
        for (unsigned a = 0; a < SELFCAL_MODEL_AXES; a++) {
            float sum = -6.0F;
            for (int i = 0; i < 12; i++) {
                seed = seed * 1664525U + 1013904223U;
                sum += (float)(seed >> 8) / 16777216.0F;
            }
            reading[a] = 0.04F * sum + 1e-5F * (float)(n * (int)a);
        }
        const float channel = 25.0F + 0.01F * (float)(n % 300);
        (void)selfcal_imu_sample(&imu, reading, &channel, NULL);
    }
    (void)selfcal_imu_ask(&imu, SELFCAL_ALL_AXES);
    while (selfcal_imu_work(&imu) == SELFCAL_BUSY) {
    }
    for (unsigned char a = 0; a < SELFCAL_MODEL_AXES; a++) {
        const selfcal_report_t *report = selfcal_imu_report(&imu, a);
        if (report == NULL) return 2;
        printf("%u %u %a %a", a, (unsigned)report->n, (double)report->bias_mean, (double)report->bias_sd);
        for (int h = 0; h < (int)SELFCAL_MODEL_HYPOTHESES; h++)
            printf(" %a %a", (double)report->hypothesis[h].probability, report->hypothesis[h].ln_evidence);
        const selfcal_sent_coefficient_t *sent = selfcal_imu_coefficients(&imu, a);
        for (unsigned k = 0; k < SELFCAL_MODEL_REGRESSORS; k++)
            printf(" %a %a", (double)sent[k].mean, (double)sent[k].probability);
        puts("");
    }
    return 0;
}
"""

REGRESSORS = """
regressors:
  - {name: temperature, kind: column, column: temp, unit: degC, reference: 25, sd: {gyro: 0.02}}
  - {name: ramp, kind: time, sd: {gyro: 1e-4}}
"""


@pytest.mark.parametrize(
    ("model", "more", "flags"),
    [
        ("default", "", ["-DSELFCAL_FIXED"]),
        ("terms", "", []),
        ("terms", REGRESSORS, ["-DSELFCAL_FIXED"]),
        ("default", REGRESSORS, []),
    ],
)
def test_a_held_report_is_the_same(model: str, more: str, flags: list[str], tmp_path: Path) -> None:
    source = ROOT / "tools" / "selfcal" / "model" / "models" / f"{model}.yaml"
    (tmp_path / "model.yaml").write_text(source.read_text() + more)
    loaded = Model.load(tmp_path / "model.yaml")
    tables = make_tables(loaded, RATE_HZ, ("gx", "gz"), "cortex-m4f")
    (tmp_path / "program.c").write_text(PROGRAM)
    lib = sorted(str(path) for path in (ROOT / "lib").glob("*.c"))
    compiler = ["cc", "-std=c99", "-O1", "-ffp-contract=off", *flags, f"-I{ROOT / 'lib'}"]
    told = []
    for hold in (False, True):
        write_tables(loaded, tables, tmp_path / f"{hold}", "cortex-m4f", hold=hold)
        if not hold:
            subprocess.run([*compiler, "-IFalse", "-c", *lib], cwd=tmp_path, check=True)
        made = ["program.c", f"{hold}/selfcal_model.c", *sorted(path.name for path in tmp_path.glob("*.o"))]
        subprocess.run([*compiler, f"-I{hold}", *made, "-lm", "-o", f"program_{hold}"], cwd=tmp_path, check=True)
        done = subprocess.run([f"./program_{hold}"], cwd=tmp_path, check=True, capture_output=True, text=True)
        told.append(done.stdout)
    assert told[0] == told[1]
    assert len(told[0].splitlines()) == len(tables.axes)


GUARDED = """#include "selfcal_model.h"
#include <string.h>
static struct { selfcal_imu_t imu; unsigned char after[4096]; } mine;
static double memory[16384];
int main(void) {
    memset(&mine, 0xA5, sizeof mine);
    const selfcal_status_t status = selfcal_imu_init(&mine.imu, &selfcal_model_pipe, memory, sizeof memory);
    for (size_t i = 0; i < sizeof mine; i++)
        if (((unsigned char *)&mine)[i] != 0xA5U) return 1;
    return status == SELFCAL_BAD_BUILD ? 0 : 2;
}
"""


def test_a_program_of_other_sizes_is_refused(tmp_path: Path) -> None:
    """Three axes in the program, six in the library, whose struct is the larger one: nothing is written."""
    (tmp_path / "program.c").write_text(GUARDED)
    model = Model.load()
    for name, axes in (("library", None), ("program", ("gx", "gy", "gz"))):
        write_tables(model, make_tables(model, RATE_HZ, axes, "cortex-m4f"), tmp_path / name, "cortex-m4f")
    lib = sorted(str(path) for path in (ROOT / "lib").glob("*.c"))
    cc = ["cc", "-std=c99", "-O0", f"-I{ROOT / 'lib'}"]
    subprocess.run([*cc, "-Ilibrary", "-c", *lib, "library/selfcal_model.c"], cwd=tmp_path, check=True)
    objects = sorted(path.name for path in tmp_path.glob("*.o"))
    subprocess.run([*cc, "-Iprogram", "program.c", *objects, "-lm", "-o", "out"], cwd=tmp_path, check=True)
    assert subprocess.run(["./out"], cwd=tmp_path, check=False).returncode == 0
