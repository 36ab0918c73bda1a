/* Ten minutes of simulated rest through the library, then a report of each axis.
 * For any C99 compiler: the tables decide the axes and the rate. */
#include "selfcal_model.h"

#include <stdio.h>

static selfcal_t bank;
static selfcal_work_t work;
static selfcal_report_t report;
static double memory[(SELFCAL_MODEL_BYTES + sizeof(double) - 1U) / sizeof(double)]; /* aligned to 8 bytes */

/* White noise of N = 0.01 unit/sqrt(Hz) around a bias of 0.5: the sum of twelve uniform numbers is nearly Gaussian.
 * Your driver comes here. */
static void read_sensor(float sample[]) {
    static uint32_t state = 1U;
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        float sum = -6.0F;
        for (int i = 0; i < 12; i++) {
            state = 1664525U * state + 1013904223U;
            sum += (float)(state >> 8) / 16777216.0F;
        }
        sample[axis] = 0.5F + 0.01F * 28.6F * sum; /* 28.6: the square root of 819.2 Hz */
    }
}

int main(void) {
    if (selfcal_init(&bank, &selfcal_model, memory, sizeof memory) != SELFCAL_OK) {
        puts("the model and the build do not go together");
        return 1;
    }
    const long samples = (long)(600.0F * SELFCAL_MODEL_RATE_HZ);
    for (long i = 0; i < samples; i++) {
        float sample[SELFCAL_MODEL_AXES];
        read_sensor(sample);
        (void)selfcal_push(&bank, sample);
    }
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        selfcal_status_t status = selfcal_report_begin(&work, &bank, axis, &report);
        while (status == SELFCAL_OK && selfcal_report_step(&work, &report) == SELFCAL_BUSY) {
        }
        if (status != SELFCAL_OK) {
            printf("%s: no report, status %d\n", selfcal_model_axis_name[axis], (int)status);
            continue;
        }
        printf("%s: bias %.4f +- %.4f\n", selfcal_model_axis_name[axis], (double)report.bias_mean,
               (double)report.bias_sd);
    }
    return 0;
}
