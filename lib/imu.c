/* The way of a sample: gate, columns, intake, bank, judgement, changes; and the reports that are due. What a pipe
 * names lies in front of the bank in the caller's memory, whose size selfcal_imu_init() has seen to be enough. */
#include "imu.h"

#include "selfcal_frames.h"

/* The caller's memory, as far as it is not given away. */
typedef struct {
    unsigned char *next;
    size_t left;
} room_t;

/* The next part; NULL: too small, and none follows. */
static void *carve(room_t *room, size_t bytes) {
    unsigned char *const part = room->next;
    if (part == NULL || bytes > room->left) {
        room->next = NULL;
        return NULL;
    }
    room->next = part + bytes;
    room->left -= bytes;
    return part;
}

/* Makes the parts that the pipe names. */
static void carve_all(selfcal_imu_t *imu, room_t *room) {
    const selfcal_pipe_t *pipe = imu->pipe;
    const selfcal_model_t *model = pipe->model;
    if (pipe->gate_code != NULL) {
        imu->gate = carve(room, SELFCAL_PART(sizeof *imu->gate));
    }
    if (pipe->columns != NULL) {
        imu->columns = carve(room, SELFCAL_PART(sizeof *imu->columns));
    }
    if (pipe->judging != NULL) {
        imu->judge = carve(room, SELFCAL_PART(sizeof *imu->judge));
    }
    if (pipe->changes != NULL) {
        imu->changes = carve(room, SELFCAL_CHANGES_SIZE(model->nodes, model->axes));
    }
    if (pipe->tumbling_code != NULL) {
        imu->tumble = carve(room, SELFCAL_PART(pipe->tumbling_code->bytes));
    }
    if (pipe->holding != NULL) {
        imu->held = carve(room, SELFCAL_HELD_SIZE(model->nodes, sum_nodes(model), regressors_of(model)));
    }
}

static void no_reports(selfcal_imu_t *imu) {
    imu->reported = 0U;
    for (uint8_t axis = 0; axis < SELFCAL_AXES_MAX; axis++) {
        imu->reason[axis] = SELFCAL_REASON_NO_REPORT;
        imu->bias[axis] = NAN;
    }
}

/* All but the bank begins anew. */
static selfcal_status_t begin_all(selfcal_imu_t *imu) {
    const selfcal_pipe_t *pipe = imu->pipe;
    selfcal_status_t status = SELFCAL_OK;
    imu->computing = false;
    imu->due = 0U;
    imu->turn = 0U;
    if (imu->columns != NULL) {
        status = pipe->columns->begin(imu);
    }
    if (imu->judge != NULL) {
        pipe->judging->begin(imu);
    }
    if (imu->changes != NULL && status == SELFCAL_OK) {
        status = pipe->changes->begin(imu);
    }
    no_reports(imu);
    return status;
}

/* Whether the pipe has all that the tables want. */
static bool goes_together(const selfcal_pipe_t *pipe) {
    return (pipe->columns != NULL) == (pipe->model->regressors != NULL) && pipe->rate_hz > 0.0F &&
           (pipe->gate_code == NULL || pipe->gate != NULL) &&
           (pipe->tumbling_code == NULL || (pipe->tumbling != NULL && pipe->gate_code != NULL)) &&
           (pipe->changes == NULL || pipe->judging != NULL);
}

selfcal_status_t selfcal_imu_init_as(uint32_t layout, selfcal_imu_t *imu, const selfcal_pipe_t *pipe, void *memory,
                                     size_t size) {
    if (layout != SELFCAL_LAYOUT) {
        return SELFCAL_BAD_BUILD;
    }
    if (imu == NULL || pipe == NULL || pipe->model == NULL || memory == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    memset(imu, 0, sizeof *imu);
    imu->pipe = pipe;
    if (!goes_together(pipe)) {
        return SELFCAL_BAD_MODEL;
    }
    room_t room = {memory, size};
    carve_all(imu, &room);
    if ((uintptr_t)memory % sizeof(selfcal_wide_t) != 0U || room.next == NULL) {
        return SELFCAL_BAD_MEMORY;
    }
    imu->memory = room.next;
    selfcal_status_t status = selfcal_init(&imu->bank, pipe->model, imu->memory, room.left);
    if (imu->tumble != NULL) {
        pipe->tumbling_code->begin(imu);
    }
    status = status == SELFCAL_OK ? begin_all(imu) : status;
    if (status == SELFCAL_OK && imu->gate != NULL && !selfcal_imu_watch(imu, true)) {
        status = SELFCAL_BAD_MODEL;
    }
    return status;
}

void selfcal_imu_keep(selfcal_imu_t *imu, selfcal_kept_t *kept) {
    if (kept != NULL) {
        memset(kept, 0, sizeof *kept);
    }
    imu->kept = kept;
    no_reports(imu); /* those so far are not in it */
}

bool selfcal_imu_watch(selfcal_imu_t *imu, bool on) {
    imu->watching = on && imu->gate != NULL && imu->pipe->gate_code->begin(imu);
    return imu->watching;
}

void selfcal_imu_skip(selfcal_imu_t *imu, uint64_t count) {
    const selfcal_pipe_t *pipe = imu->pipe;
    if (count == 0U) {
        return;
    }
    if (imu->watching) {
        pipe->gate_code->skip(imu, count);
    }
    if (imu->tumble != NULL) {
        pipe->tumbling_code->skip(imu, count);
    }
    (void)selfcal_skip(&imu->bank, count);
    if (imu->columns != NULL) {
        pipe->columns->skip(imu, count);
    }
    if (imu->kept != NULL) {
        imu->kept->passed += count;
    }
}

/* Something has changed: the last reports of such an axis are of the past, and so is one under way. */
static uint32_t handle_changes(selfcal_imu_t *imu) {
    const uint32_t changed = imu->pipe->changes->handle(imu);
    if (imu->held != NULL && (changed >> imu->report.axis & 1U) != 0U) {
        imu->held->batches++;
    }
    for (uint8_t axis = 0; changed != 0U && axis < imu->bank.model->axes; axis++) {
        if ((changed >> axis & 1U) != 0U) {
            imu->reason[axis] = SELFCAL_REASON_NO_REPORT;
        }
    }
    imu->reported &= (uint16_t)~changed;
    return changed;
}

uint32_t selfcal_imu_sample(selfcal_imu_t *imu, const float reading[], const float channels[], const float side[]) {
    const selfcal_model_t *model = imu->bank.model;
    const selfcal_pipe_t *pipe = imu->pipe;
    const float *values = imu->columns != NULL ? pipe->columns->form(imu, reading, channels) : NULL;
    uint32_t found = 0;
    const bool rests = !imu->watching || pipe->gate_code->rests(imu, reading);
    const bool taken = imu->tumble != NULL && pipe->tumbling_code->take(imu, reading);
    if (!taken && rests) {
        (void)selfcal_push_with(&imu->bank, reading, values); /* what it rejects it counts */
    } else if (!taken) {
        (void)selfcal_push_moving(&imu->bank, reading);
    }
    if (imu->judge != NULL) {
        pipe->judging->sample(imu, side, values);
    }
    if (imu->changes != NULL) {
        found = handle_changes(imu);
    }
    if (imu->kept != NULL) {
        imu->kept->passed++;
        imu->kept->newer = true;
        memcpy(imu->kept->reading, reading, model->axes * sizeof reading[0]);
    }
    if (imu->gate != NULL && imu->gate->at_once != imu->gate->gate.at_once) {
        imu->gate->at_once = imu->gate->gate.at_once;
        found |= SELFCAL_IMU_DEAR;
    }
    return found;
}

/* With no room for a bank sample an interval may still end without one: less than half of its samples are usable
 * then. */
bool selfcal_imu_room(const selfcal_imu_t *imu) {
    const uint32_t block = imu->bank.block, used = imu->bank.used + 1U;
    return !imu->computing || imu->held != NULL || selfcal_room(&imu->bank) > 0U || used < block - used;
}

/* Begins the next of the reports that are due and can be made, each axis in its turn. */
static selfcal_status_t begin_report(selfcal_imu_t *imu) {
    selfcal_status_t status = SELFCAL_OK;
    while (!imu->computing && imu->due != 0U) {
        const uint8_t axis = imu->turn;
        imu->turn = (uint8_t)(axis + 1U < imu->bank.model->axes ? axis + 1U : 0U);
        if (((uint32_t)imu->due >> axis & 1U) != 0U) {
            imu->due &= (uint16_t)~(1U << axis);
            imu->whole = false;
            status = selfcal_report_begin(&imu->work, &imu->bank, axis, &imu->report);
            imu->computing = status == SELFCAL_OK;
        }
    }
    return imu->computing ? SELFCAL_BUSY : status;
}

selfcal_status_t selfcal_imu_ask(selfcal_imu_t *imu, uint32_t axes) {
    imu->due |= (uint16_t)(axes & ((1U << imu->bank.model->axes) - 1U));
    return begin_report(imu);
}

/* The report is whole. */
static void take_report(selfcal_imu_t *imu) {
    const uint8_t axis = imu->report.axis;
    selfcal_adequacy_state_t state = SELFCAL_NOT_JUDGED;
    if (imu->judge != NULL) {
        state = imu->pipe->judging->report(imu);
    }
    imu->reason[axis] = selfcal_reason(imu->bank.model, &imu->report, state);
    imu->bias[axis] = imu->report.bias_mean;
    imu->whole = true;
    imu->reported |= (uint16_t)(1U << axis);
    if (imu->kept != NULL) {
        imu->kept->report[axis] = imu->report;
        imu->kept->rests_on[axis] = imu->kept->gathered_at;
    }
}

/* A report that is identified stays the one to rely on. */
static void take_overtaken(selfcal_imu_t *imu, selfcal_reason_t *reason) {
    const bool rough = *reason == SELFCAL_REASON_NO_REPORT || *reason == SELFCAL_REASON_NOT_IDENTIFIED;
    *reason = rough ? SELFCAL_REASON_OVERTAKEN : *reason;
    imu->bank.counters.overtaken += imu->held != NULL ? 1U : 0U; /* else the bank has counted it */
}

selfcal_status_t selfcal_imu_work(selfcal_imu_t *imu) {
    if (!imu->computing) {
        return begin_report(imu);
    }
    if (imu->kept != NULL && !imu->work.gathered) {
        imu->kept->gathered_at = imu->kept->passed - imu->bank.position;
    }
    const selfcal_status_t status =
        imu->columns != NULL ? imu->pipe->columns->step(imu) : selfcal_report_step(&imu->work, &imu->report);
    if (status == SELFCAL_BUSY) {
        if (imu->held != NULL) {
            imu->pipe->holding->follow(imu);
        }
        return status;
    }
    imu->computing = false;
    if (status == SELFCAL_OK) {
        take_report(imu);
    } else if (status == SELFCAL_OVERTAKEN) {
        take_overtaken(imu, &imu->reason[imu->report.axis]);
    }
    return imu->due != 0U ? SELFCAL_BUSY : status;
}

const selfcal_report_t *selfcal_imu_report(const selfcal_imu_t *imu, uint8_t axis) {
    SELFCAL_ASSERT(axis < imu->bank.model->axes);
    if (!has_report(imu, axis)) {
        return NULL;
    }
    if (imu->kept != NULL) {
        return &imu->kept->report[axis];
    }
    return imu->whole && imu->report.axis == axis ? &imu->report : NULL;
}

const selfcal_judgement_t *selfcal_imu_judgement(const selfcal_imu_t *imu, uint8_t axis) {
    SELFCAL_ASSERT(axis < imu->bank.model->axes);
    return imu->judge != NULL ? &imu->judge->judged[axis] : NULL;
}

const selfcal_sent_coefficient_t *selfcal_imu_coefficients(const selfcal_imu_t *imu, uint8_t axis) {
    SELFCAL_ASSERT(axis < imu->bank.model->axes);
    return imu->columns != NULL ? imu->columns->sent[axis] : NULL;
}

uint32_t selfcal_imu_motion(const selfcal_imu_t *imu) {
    if (!imu->watching) {
        return SELFCAL_STATUS_MOTION_NOT_WATCHED;
    }
    return imu->gate->gate.state == SELFCAL_RESTING ? SELFCAL_STATUS_MOTION_RESTING : SELFCAL_STATUS_MOTION_MOVING;
}

selfcal_reason_t selfcal_imu_reason(const selfcal_imu_t *imu, uint8_t axis) {
    if (selfcal_retired(&imu->bank, axis)) {
        return SELFCAL_REASON_RETIRED;
    }
    const selfcal_reason_t known = imu->reason[axis];
    const bool moving = selfcal_imu_motion(imu) == SELFCAL_STATUS_MOTION_MOVING;
    return known == SELFCAL_REASON_NO_REPORT && moving ? SELFCAL_REASON_MOVING : known;
}

float selfcal_imu_bias(const selfcal_imu_t *imu, uint8_t axis) {
    SELFCAL_ASSERT(axis < imu->bank.model->axes);
    return imu->bias[axis];
}

selfcal_status_t selfcal_imu_shift(selfcal_imu_t *imu, uint8_t axis, float amount) {
    const selfcal_status_t status = selfcal_shift(&imu->bank, axis, amount);
    if (status != SELFCAL_OK) {
        return status;
    }
    imu->bias[axis] += amount;
    if (imu->watching) {
        imu->pipe->gate_code->shift(imu, axis, amount);
    }
    if (imu->kept != NULL) {
        selfcal_report_t *report = &imu->kept->report[axis];
        imu->kept->newer = false; /* the reading is one from before */
        report->bias_mean += amount;
        for (uint8_t h = 0; h < SELFCAL_HYPOTHESES_MAX; h++) {
            report->hypothesis[h].bias_mean += amount;
        }
    }
    return status;
}

selfcal_status_t selfcal_imu_power_on(selfcal_imu_t *imu, uint64_t samples) {
    const selfcal_status_t status = selfcal_power_on(&imu->bank, samples);
    return status == SELFCAL_OK ? begin_all(imu) : status;
}

selfcal_status_t selfcal_imu_forget(selfcal_imu_t *imu) {
    float shifted[SELFCAL_AXES_MAX] = {0.0F};
    const selfcal_model_t *model = imu->bank.model;
    for (uint8_t axis = 0; axis < model->axes; axis++) {
        shifted[axis] = selfcal_shifted(&imu->bank, axis);
    }
    const selfcal_status_t status = selfcal_init(&imu->bank, model, imu->memory, SIZE_MAX);
    for (uint8_t axis = 0; axis < model->axes; axis++) {
        (void)selfcal_shift(&imu->bank, axis, shifted[axis]);
    }
    (void)begin_all(imu);
    if (imu->tumble != NULL) {
        imu->pipe->tumbling_code->begin(imu);
    }
    if (imu->watching) { /* its windows go on: the bank must start with one of them */
        (void)selfcal_imu_watch(imu, true);
    }
    return status;
}

selfcal_status_t selfcal_imu_save(const selfcal_imu_t *imu, selfcal_write_t write, void *context) {
    const selfcal_status_t status = selfcal_save(&imu->bank, write, context);
    if (status == SELFCAL_OK && imu->tumble != NULL && !imu->pipe->tumbling_code->save(imu, write, context)) {
        return SELFCAL_WRITE_FAILED;
    }
    return status;
}

selfcal_status_t selfcal_imu_restore(selfcal_imu_t *imu, const void *snapshot, size_t length, uint64_t gap) {
    selfcal_t *bank = &imu->bank;
    selfcal_status_t status = SELFCAL_OK;
    if (imu->tumble != NULL && snapshot != NULL) {
        status = imu->pipe->tumbling_code->restore(imu, snapshot, &length);
    }
    if (status != SELFCAL_OK) {
        return status;
    }
    status = selfcal_restore(bank, imu->pipe->model, imu->memory, SIZE_MAX, snapshot, length);
    if (status == SELFCAL_OK) {
        /* Up to the start of a bank interval: it holds whole windows of the gate. */
        (void)selfcal_moving(bank);
        const uint64_t block = bank->block, past = (bank->position + gap) % block;
        (void)selfcal_skip(bank, gap + (past > 0U ? block - past : 0U));
    }
    if (status == SELFCAL_OK || status == SELFCAL_CORRUPT) { /* the latter leaves a bank without a sample */
        (void)begin_all(imu);
    }
    return status;
}
