/* Forgetting: a bank sample counts for 2^-(age / half-life) in every sum, from one batch to the next. Linked only with
 * a model that forgets. */
#include "bank_inside.h"

/* Bank samples that the sums count for at least. */
#define WEIGHT_MIN 1e-6

/* However long a gap, no sum becomes 0. */
static selfcal_wide_t part_kept(selfcal_t *self) {
    const selfcal_batch_t *batch = waiting(self);
    selfcal_wide_t intervals = (selfcal_wide_t)batch->count + (selfcal_wide_t)batch->gap_after;
    for (uint32_t i = 0; i < batch->count; i++) {
        intervals += (selfcal_wide_t)batch->gap[i];
    }
    const selfcal_wide_t half_lives =
        intervals * (selfcal_wide_t)self->model->dt_s / (selfcal_wide_t)self->model->forgetting->half_life_s;
    const selfcal_wide_t keep = fmin(fmax(exp(-0.69314718055994530942 * half_lives), WEIGHT_MIN / self->weight), 1.0);
    self->beginning *= keep;
    return keep;
}

/* Samples that the node has only counted come due first. Readings and columns each shrink by a factor, and products
 * of them by both factors. So the sums remain the sums of some record (positive definite). */
static void fade_node(selfcal_t *self, size_t j) {
    selfcal_node_t *node = &self->node[j];
    const bool of_sum = is_state_node(self, node);
    if (of_sum) {
        self->model->states->settle(self, j);
    }
    const selfcal_wide_t a = sum_value(node->a) + level_a(node), part = sqrt(self->keep);
    const selfcal_wide_t part_of_one = self->keep * a > SELFCAL_KEPT_MIN ? part : 1.0;
    node->a = make_sum(part_of_one * part_of_one * a);
    node->ln_s = make_sum(self->keep *
                          (sum_value(node->ln_s) + (selfcal_wide_t)node->steady * log1p((selfcal_wide_t)node->p_inf)));
    node->steady = 0;
    node->level_from = 0;
    selfcal_kernel_fade(self, j, part * part_of_one, self->keep);
    if (of_sum) {
        self->model->states->fade(self, j, part * part_of_one, self->keep);
    }
    if (self->columns != NULL) {
        self->model->regressors->code->fade(self, j, part, part_of_one);
    }
}

const selfcal_forgetting_code_t selfcal_forgetting_code = {part_kept, fade_node};
