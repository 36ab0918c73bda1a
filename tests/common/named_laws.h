/* The laws that a model file names (tools/selfcal/model/laws.py). */
#ifndef TEST_LAWS_H
#define TEST_LAWS_H

#include "selfcal.h"

enum { CONSTANT, RANDOM_WALK, GAUSS_MARKOV, FLICKER, MOVING_AVERAGE, WALK_AND_MARKOV, NAMED_LAWS };

static const selfcal_law_t named_law[NAMED_LAWS] = {
    [CONSTANT] = {0U, false, {{SELFCAL_WALK, 0.0F, 0.0F, false, false}}},
    [RANDOM_WALK] = {1U, false, {{SELFCAL_WALK, 1.0F, 0.0F, false, false}}},
    [GAUSS_MARKOV] = {1U, false, {{SELFCAL_MARKOV, 1.0F, 1.0F, false, false}}},
    [FLICKER] = {3U,
                 false,
                 {{SELFCAL_MARKOV, 0.96F, 0.0625F, false, false},
                  {SELFCAL_MARKOV, 0.96F, 1.0F, false, false},
                  {SELFCAL_MARKOV, 0.96F, 16.0F, false, false}}},
    [MOVING_AVERAGE] = {1U, true, {{SELFCAL_WALK, 1.0F, 0.0F, false, false}}},
    /* a correlation time of 100 s */
    [WALK_AND_MARKOV] = {2U,
                         false,
                         {{SELFCAL_WALK, 1.0F, 0.0F, false, false}, {SELFCAL_MARKOV, 1.0F, 0.01F, true, true}}},
};

#endif
