/* A bank of one axis over one law of the default model, a bank sample a second unless a test sets otherwise. */
#ifndef ONE_AXIS_H
#define ONE_AXIS_H

#include <math.h>
#include <string.h>

/* Before the names below, which its functions have as well. */
#include "report_inside.h"

#include "noise.h"
#include "selfcal_model.h"
#include "unity.h"

enum { CONSTANT_LAW, WALK_LAW, MARKOV_LAW };

static selfcal_model_t model;
static selfcal_hypothesis_t hypothesis;
static selfcal_t bank;
/* Room for a law of sums and for two regressors as well. */
static selfcal_wide_t memory[SELFCAL_SIZE(SELFCAL_MODEL_NODES, 4U) / sizeof(selfcal_wide_t)];

static inline int kind_of(const selfcal_hypothesis_t *one) {
    return one->rho == NULL ? CONSTANT_LAW : one->alpha == NULL ? WALK_LAW : MARKOV_LAW;
}

/* The model with this law alone. */
static inline void choose(int kind) {
    model = selfcal_model;
    model.axes = 1;
    model.block = 1;
    model.dt_s = 1.0F;
    uint8_t h = 0;
    while (kind_of(&selfcal_model.hypothesis[h]) != kind) {
        h++;
    }
    hypothesis = selfcal_model.hypothesis[h];
    hypothesis.ln_probability = 0.0F;
    model.hypothesis = &hypothesis;
    model.hypotheses = 1;
    model.nodes = (uint16_t)((kind == CONSTANT_LAW ? 1U : hypothesis.rho->nodes) *
                             (kind == MARKOV_LAW ? hypothesis.alpha->nodes : 1U));
}

static inline void begin(void) {
    state = 12345U;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&bank, &model, memory, sizeof memory));
}

static inline void push(float sample) {
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, &sample));
}

/* Whether `got` is `truth` to `relative` of it. */
static inline bool close_to(double truth, double got, double relative) {
    return fabs(got - truth) <= relative * fabs(truth);
}

#endif
