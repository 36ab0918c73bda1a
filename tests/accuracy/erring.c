/* How far reports move when each function of <math.h> errs by ULPS units in the last place: all up, all down, every
 * second function up, and each call by a random part of it. Prints the worst of all records: dP, d mean/sd, d sd/sd, d
 * ln evidence. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "../common/noise.h"
#include "erring.h"
#include "selfcal_model.h"
/* not for what follows */
#undef exp
#undef expf
#undef sqrt

enum { AXES = SELFCAL_MODEL_AXES, HYPOTHESES = SELFCAL_MODEL_HYPOTHESES, MODES = 6 };

static int mode, ulps;
static uint32_t turn;

static int error_of(int which) {
    switch (mode) {
    case 0: return 0;
    case 1: return ulps;
    case 2: return -ulps;
    case 3: return which % 2 == 0 ? ulps : -ulps;
    case 4: return which % 2 == 0 ? -ulps : ulps;
    default: turn = turn * 1664525U + 1013904223U; return (int)((turn >> 8) % (2U * (unsigned)ulps + 1U)) - ulps;
    }
}

float erring_float(float value, int which) {
    if (value == 0.0F || !isfinite(value)) {
        return value;
    }
    int32_t bits;
    memcpy(&bits, &value, sizeof bits);
    bits += error_of(which);
    memcpy(&value, &bits, sizeof value);
    return value;
}

double erring_double(double value, int which) {
    if (value == 0.0 || !isfinite(value)) {
        return value;
    }
    int64_t bits;
    memcpy(&bits, &value, sizeof bits);
    bits += error_of(which);
    memcpy(&value, &bits, sizeof value);
    return value;
}

static selfcal_t bank;
static selfcal_model_t model;
static selfcal_wide_t memory[SELFCAL_SIZE(SELFCAL_MODEL_NODES, AXES) / sizeof(selfcal_wide_t) + 1U];
static selfcal_work_t work;
static selfcal_report_t report[MODES][AXES];

static double worst[4];

static void worse(int k, double value) {
    if (!(value <= worst[k])) {
        worst[k] = value;
    }
}

static void compare(const selfcal_report_t *true_one, const selfcal_report_t *other) {
    for (int h = 0; h < HYPOTHESES; h++) {
        const selfcal_posterior_t *a = &true_one->hypothesis[h], *b = &other->hypothesis[h];
        worse(0, fabs((double)a->probability - (double)b->probability));
        if (!(a->probability > 1e-6F)) {
            /* One that is ruled out may lean on a limit of N, so closely that what ln N is rounded by shows. */
            continue;
        }
        worse(3, fabs(a->ln_evidence - b->ln_evidence));
        for (int p = 0; p < SELFCAL_PARAMETERS; p++) {
            const selfcal_estimate_t *ours = &a->parameter[p], *theirs = &b->parameter[p];
            if (!isnan(ours->mean)) {
                worse(1, fabs((double)(ours->mean - theirs->mean) / (double)ours->sd));
                worse(2, fabs((double)theirs->sd / (double)ours->sd - 1.0));
            }
        }
    }
    worse(1, fabs((double)(true_one->bias_mean - other->bias_mean) / (double)true_one->bias_sd));
    worse(2, fabs((double)other->bias_sd / (double)true_one->bias_sd - 1.0));
}

/* White noise 0.04; axis by axis no drift, random walks, Gauss-Markov drifts, the last about a bias of 10 000 times the
 * noise. */
static void push_record(unsigned n) {
    static const float steps[AXES] = {0.0F, 1e-3F, 0.02F, 5e-4F, 4e-3F, 0.0F},
                       holds[AXES] = {1.0F, 1.0F, 1.0F, 0.999F, 0.98F, 1.0F};
    float drift[AXES] = {0};
    state = 12345U;
    for (unsigned i = 0; i < n; i++) {
        float sample[AXES];
        for (unsigned axis = 0; axis < AXES; axis++) {
            drift[axis] = holds[axis] * drift[axis] + steps[axis] * noise();
            sample[axis] = (axis == 5U ? 400.0F : 0.3F) + drift[axis] + 0.04F * noise();
        }
        if (selfcal_push(&bank, sample) != SELFCAL_OK ||
            (i % 997U == 700U && selfcal_skip(&bank, i % 13U) != SELFCAL_OK)) {
            exit(2);
        }
    }
}

int main(int argc, char **argv) {
    static selfcal_axis_t axes[AXES];
    ulps = argc > 1 ? atoi(argv[1]) : 1;
    model = selfcal_model;
    model.block = 1;
    model.dt_s = 1.0F;
    model.axis = axes;
    for (unsigned axis = 0; axis < AXES; axis++) {
        axes[axis] = selfcal_model.axis[0];
        axes[axis].range = 0.0F;
        axes[axis].bias_sd = 400.0F; /* no further from its prior than it may be */
    }
    for (int k = 2; k < argc; k++) {
        const unsigned n = (unsigned)atoi(argv[k]);
        memset(worst, 0, sizeof worst);
        for (mode = 0; mode < MODES; mode++) {
            if (selfcal_init(&bank, &model, memory, sizeof memory) != SELFCAL_OK) {
                return 2;
            }
            push_record(n);
            for (uint8_t axis = 0; axis < AXES; axis++) {
                if (selfcal_report(&work, &bank, axis, &report[mode][axis]) != SELFCAL_OK) {
                    return 2;
                }
                compare(&report[0][axis], &report[mode][axis]);
            }
        }
        (void)printf("%u %.3g %.3g %.3g %.3g\n", n, worst[0], worst[1], worst[2], worst[3]);
    }
    return 0;
}
