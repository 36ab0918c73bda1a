/* A block's sums in selfcal_real_t, about the block's first sample: gravity or a turn-on bias costs no digits. */
#include "bank_inside.h"

#ifndef SELFCAL_FIXED

void selfcal_intake_start(selfcal_t *self) {
    memset(self->sums, 0, sizeof self->sums);
}

void selfcal_intake_add(selfcal_t *self, const float sample[], uint32_t live) {
    const uint8_t axes = self->model->axes;
    for (uint8_t axis = 0; axis < axes; axis++) {
        selfcal_block_t *sums = &self->sums[axis];
        if (self->used == 0U) {
            sums->first = sample[axis];
        }
        if ((live >> axis & 1U) != 0U) {
            const selfcal_real_t from_first = (selfcal_real_t)sample[axis] - (selfcal_real_t)sums->first;
            sums->sum += from_first;
            sums->sum_sq = r_fma(from_first, from_first, sums->sum_sq);
        }
    }
}

selfcal_real_t selfcal_intake_level(const selfcal_t *self, uint8_t axis, selfcal_wide_t *scatter) {
    const selfcal_block_t *sums = &self->sums[axis];
    const selfcal_real_t mean = sums->sum / (selfcal_real_t)self->used;
    *scatter = (selfcal_wide_t)r_fmax(r_fma(-sums->sum, mean, sums->sum_sq), R(0.0));
    return (selfcal_real_t)sums->first - (selfcal_real_t)self->origin[axis] + mean;
}

bool selfcal_intake_sound(const selfcal_t *self, uint8_t axis) {
    const selfcal_block_t *sums = &self->sums[axis];
    return isfinite(sums->first) && isfinite(sums->sum) && sums->sum_sq >= R(0.0) && isfinite(sums->sum_sq);
}

#else
typedef int selfcal_no_float_intake_t; /* C99 wants a declaration in every file */
#endif
