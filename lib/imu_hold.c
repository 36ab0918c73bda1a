/* A report that no sample overtakes: it rests on a copy of its axis's sums. The nodes run over all that the bank has
 * gathered, then the copy is taken at once. From there on the bank goes on without the report. */
#include "imu.h"

#include "report_inside.h"

static selfcal_t *hold(const selfcal_t *self, uint8_t axis, selfcal_t *held) {
    *held = *self;
    held->held = true;
    for (size_t i = 0; i < 2U; i++) { /* gathered since: not in the sums */
        held->batch[i].count = 0U;
        held->batch[i].gap_after = 0U;
    }
    held->pending_gap = 0U;
    selfcal_bank_lay_out(held, (unsigned char *)held + SELFCAL_PART(sizeof *held));
    const size_t nodes = self->model->nodes;
    memcpy(held->node, self->node, nodes * sizeof held->node[0]);
    for (size_t j = 0; j < nodes; j++) {
        const size_t at = cell_of(self, j, axis);
        held->b[j] = self->b[at];
        held->c[j] = self->c[at];
        held->x[j] = self->x[at];
    }
    if (held->columns != NULL) {
        self->model->regressors->code->hold(held, self, axis);
    }
    if (held->terms != NULL) {
        self->model->states->hold(held, self, axis);
    }
    return held;
}

static void take_copy(selfcal_imu_t *imu) {
    selfcal_work_t *work = &imu->work;
    if (work->bank == &imu->bank && work->stage > GATHER) {
        work->bank = hold(&imu->bank, work->axis, imu->held);
    }
}

const selfcal_holding_code_t selfcal_holding_code = {take_copy};
