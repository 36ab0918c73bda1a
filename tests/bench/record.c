#include "record.h"

void record_init(record_t *record) {
    record->state = 2463534242U;
}

/* Sum of four uniform variates, sd 1. */
static float noise(record_t *record) {
    int32_t sum = 0;
    for (int i = 0; i < 4; i++) {
        uint32_t s = record->state; /* Marsaglia's xorshift32 */
        s ^= s << 13;
        s ^= s >> 17;
        s ^= s << 5;
        record->state = s;
        sum += (int32_t)(s >> 16);
    }
    return (float)(sum - 2 * 65535) * (1.0F / 37837.0F); /* 65536 sqrt(4/12) */
}

void record_next(record_t *record, float sample[SELFCAL_MODEL_AXES]) {
    static const float bias[6] = {0.35F, -0.19F, -0.42F, 0.04F, -0.03F, 9.81F};
    for (unsigned axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        sample[axis] = bias[axis % 6U] + (axis < 3U ? 0.04F : 0.006F) * noise(record);
    }
}

selfcal_model_t record_model(void) {
    selfcal_model_t model = selfcal_model;
    model.block = 1;
    model.dt_s = 1.0F;
    return model;
}

selfcal_model_t record_narrow_model(bool fast, selfcal_axis_t axis[SELFCAL_MODEL_AXES]) {
    for (unsigned a = 0; a < SELFCAL_MODEL_AXES; a++) {
        axis[a] = selfcal_model.axis[a];
        for (int p = SELFCAL_K; p < SELFCAL_PARAMETERS; p++) {
            selfcal_prior_t *prior = &axis[a].prior[p];
            if (fast) {
                prior->ln_min = prior->ln_max - 1.0F;
            } else {
                prior->ln_max = prior->ln_min + 1.0F;
            }
        }
    }
    selfcal_model_t model = record_model();
    model.axis = axis;
    return model;
}

unsigned record_settled(const selfcal_t *bank) {
    unsigned settled = 0;
    for (unsigned j = 0; j < bank->model->nodes; j++) {
        settled += bank->node[j].level;
    }
    return settled;
}
