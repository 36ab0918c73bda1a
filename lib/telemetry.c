/* Reports and status as frames. Items, bits and scales: selfcal_frames.h, made from selfcal.dbc. */
#include "bank_inside.h"
#include "selfcal_frames.h"

#include <math.h>
#include <string.h>

enum { STATUS, REPORT, CORRECTED, ANSWER, WORDS }; /* what the frames under way are of */
enum { NO_PARAMETER = SELFCAL_PARAMETERS };
enum { REASON_BITS = 4 };

static const char *const axis_names[SELFCAL_FRAME_AXES] = SELFCAL_FRAME_AXIS_NAMES;

/* Items of the places lie evenly, so that loops reach them. */
SELFCAL_STATIC_ASSERT(places_are_even,
                      SELFCAL_HYPOTHESIS_P1_MEAN == SELFCAL_HYPOTHESIS_N_MEAN + SELFCAL_FRAME_STATISTICS &&
                          SELFCAL_HYPOTHESIS_P2_MEAN == SELFCAL_HYPOTHESIS_P1_MEAN + SELFCAL_FRAME_STATISTICS &&
                          SELFCAL_HYPOTHESIS_P2_FLAGS_SHIFT == 2 * SELFCAL_HYPOTHESIS_P1_FLAGS_SHIFT);
SELFCAL_STATIC_ASSERT(judgement_is_as_on_the_wire,
                      (unsigned)SELFCAL_INADEQUATE == SELFCAL_ADEQUACY_ADEQUACY_INADEQUATE &&
                          (unsigned)SELFCAL_SUSPECT_TWO_LEVEL == SELFCAL_ADEQUACY_SUSPICION_TWO_LEVEL &&
                          (unsigned)SELFCAL_SUSPECT_TWO_LEVEL == SELFCAL_ADEQUACY_CHANGE_TWO_LEVEL &&
                          (unsigned)SELFCAL_REASON_STUCK == SELFCAL_ADEQUACY_REASON_STUCK);
SELFCAL_STATIC_ASSERT(reasons_lie_alike,
                      SELFCAL_STATUS_REASON_GX_SHIFT == SELFCAL_CORRECTED_REASON_GX_SHIFT &&
                          SELFCAL_STATUS_REASON_AZ_SHIFT == SELFCAL_STATUS_REASON_GX_SHIFT + 5 * REASON_BITS &&
                          SELFCAL_CORRECTED_REASON_AZ_SHIFT == SELFCAL_STATUS_REASON_AZ_SHIFT);
enum { COLUMN_ITEMS = SELFCAL_COEFFICIENTS_C0_PROBABILITY + 1 };

uint16_t selfcal_crc12(const uint8_t *data, size_t length) {
    uint32_t crc = 0xFFFU;
    for (size_t i = 0; i < length; i++) {
        crc ^= (uint32_t)data[i] << 4;
        for (int bit = 0; bit < 8; bit++) {
            crc = (crc << 1) ^ ((crc & 0x800U) != 0U ? 0xF13U : 0U);
        }
        crc &= 0xFFFU;
    }
    return (uint16_t)crc;
}

/* `value` in steps of 1 / `per_unit` as a 32-bit two's complement number, held at its ends. NaN: the lower end. */
static uint32_t scaled_bits(selfcal_wide_t value, selfcal_wide_t per_unit) {
    const selfcal_wide_t scaled = floor(value * per_unit + 0.5);
    int32_t held;
    if (scaled >= (selfcal_wide_t)INT32_MAX) {
        held = INT32_MAX;
    } else if (scaled > (selfcal_wide_t)INT32_MIN) {
        held = (int32_t)scaled;
    } else {
        held = INT32_MIN;
    }
    return (uint32_t)held;
}

static uint32_t held_count(uint64_t count) {
    return count < UINT32_MAX ? (uint32_t)count : UINT32_MAX;
}

selfcal_status_t selfcal_telemetry_init(selfcal_telemetry_t *self, const selfcal_model_t *model,
                                        const char *const axis_name[]) {
    if (self == NULL || model == NULL || axis_name == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (model->axes > SELFCAL_AXES_MAX || model->hypotheses > SELFCAL_HYPOTHESES_MAX ||
        model->hypotheses > SELFCAL_FRAME_HYPOTHESES) {
        return SELFCAL_BAD_MODEL;
    }
    memset(self, 0, sizeof *self);
    self->model = model;
    self->first_id = SELFCAL_FRAME_STATUS_ID;
    for (uint8_t axis = 0; axis < model->axes; axis++) {
        uint8_t found = 0;
        if (axis_name[axis] == NULL) {
            return SELFCAL_BAD_ARGUMENT;
        }
        while (found < SELFCAL_FRAME_AXES && strcmp(axis_name[axis], axis_names[found]) != 0) {
            found++;
        }
        if (found == SELFCAL_FRAME_AXES) {
            return SELFCAL_BAD_MODEL;
        }
        for (uint8_t other = 0; other < axis; other++) {
            if (self->message[other] == found) {
                return SELFCAL_BAD_MODEL;
            }
        }
        self->message[axis] = found;
    }
    return SELFCAL_OK;
}

selfcal_status_t selfcal_telemetry_node(selfcal_telemetry_t *self, uint8_t node) {
    if (self == NULL || node >= SELFCAL_FRAME_NODES) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (self->items != 0) {
        return SELFCAL_BUSY;
    }
    self->first_id = (uint16_t)(SELFCAL_FRAME_STATUS_ID + SELFCAL_FRAME_NODE_IDS * node);
    return SELFCAL_OK;
}

void selfcal_telemetry_coefficients(selfcal_telemetry_t *self, const selfcal_sent_coefficient_t column[]) {
    self->coefficient = column;
}

void selfcal_telemetry_adequacy(selfcal_telemetry_t *self, const selfcal_judgement_t *judgement) {
    self->judgement = judgement;
}

/* Frames of the message that node 0 sends as `id` next, its items `first` to `last`. */
static void begin_message(selfcal_telemetry_t *self, uint32_t id, uint32_t first, uint32_t last) {
    self->id = (uint16_t)(id - SELFCAL_FRAME_STATUS_ID + self->first_id);
    self->item = (uint8_t)first;
    self->items = (uint8_t)(last + 1U);
}

/* Frames of `source` next, of one message; false while others are under way. */
static bool begin(selfcal_telemetry_t *self, uint8_t source, uint32_t id, uint32_t last, uint32_t time_ms) {
    if (self->items != 0) {
        return false;
    }
    self->source = source;
    self->time_ms = time_ms;
    self->part = 0;
    self->made = 0;
    begin_message(self, id, 0, last);
    return true;
}

/* Columns whose coefficients are sent. */
static uint8_t columns(const selfcal_telemetry_t *self) {
    return self->coefficient != NULL && self->model->regressors != NULL ? self->model->regressors->count : 0U;
}

/* A report is its opening, a part for each hypothesis, the coefficients, the adequacy and the end. Goes to the next
 * part. False after the last part, and in frames that are no report. */
static bool next_part(selfcal_telemetry_t *self) {
    const uint32_t hypotheses = self->model->hypotheses;
    if (self->source != REPORT || self->part > hypotheses + 2U) {
        return false;
    }
    const uint32_t axis = self->message[self->report->axis], k = self->part++;
    if (k < hypotheses) {
        const uint32_t id = SELFCAL_FRAME_HYPOTHESIS_ID + SELFCAL_FRAME_HYPOTHESES * axis + k;
        begin_message(self, id, 0, SELFCAL_HYPOTHESIS_P2_Q95);
    } else if (k == hypotheses && columns(self) > 0U) {
        begin_message(self, SELFCAL_FRAME_COEFFICIENTS_ID + axis, 0, COLUMN_ITEMS * columns(self) - 1U);
    } else if (k <= hypotheses + 1U && self->judgement != NULL) {
        self->part = (uint8_t)(hypotheses + 2U);
        begin_message(self, SELFCAL_FRAME_ADEQUACY_ID + axis, 0,
                      self->judgement->changes > 0U ? (uint8_t)SELFCAL_ADEQUACY_CHANGE_AGO
                                                    : (uint8_t)SELFCAL_ADEQUACY_TEMPERATURE_SPAN);
    } else {
        self->part = (uint8_t)(hypotheses + 3U);
        begin_message(self, SELFCAL_FRAME_AXIS_ID + axis, SELFCAL_AXIS_END_ITEMS, SELFCAL_AXIS_END_ITEMS);
    }
    return true;
}

selfcal_status_t selfcal_telemetry_report(selfcal_telemetry_t *self, const selfcal_report_t *report,
                                          const selfcal_counters_t *counters, uint32_t time_ms) {
    if (self == NULL || report == NULL || counters == NULL || report->axis >= self->model->axes) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (!begin(self, REPORT, SELFCAL_FRAME_AXIS_ID + self->message[report->axis], SELFCAL_AXIS_BIAS_SD, time_ms)) {
        return SELFCAL_BUSY;
    }
    self->report = report;
    self->counters = counters;
    self->ln_best = report->hypothesis[0].ln_evidence;
    for (uint8_t k = 1; k < self->model->hypotheses; k++) {
        if (report->hypothesis[k].ln_evidence > self->ln_best) {
            self->ln_best = report->hypothesis[k].ln_evidence;
        }
    }
    return SELFCAL_OK;
}

void selfcal_telemetry_module(selfcal_telemetry_t *self, const selfcal_module_t *module) {
    self->module = module;
}

selfcal_status_t selfcal_telemetry_status(selfcal_telemetry_t *self, const selfcal_counters_t *counters,
                                          selfcal_state_t state, uint32_t report_number, uint32_t time_ms) {
    if (self == NULL || counters == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (!begin(self, STATUS, SELFCAL_FRAME_STATUS_ID, SELFCAL_STATUS_FRAMES_SENT, time_ms)) {
        return SELFCAL_BUSY;
    }
    self->counters = counters;
    self->state = state;
    self->report_number = report_number;
    return SELFCAL_OK;
}

selfcal_status_t selfcal_telemetry_corrected(selfcal_telemetry_t *self, const selfcal_corrected_t *corrected,
                                             uint32_t time_ms) {
    if (self == NULL || corrected == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (!begin(self, CORRECTED, SELFCAL_FRAME_CORRECTED_ID, SELFCAL_CORRECTED_MOTION, time_ms)) {
        return SELFCAL_BUSY;
    }
    self->corrected = corrected;
    return SELFCAL_OK;
}

selfcal_status_t selfcal_telemetry_answer(selfcal_telemetry_t *self, uint8_t item, uint32_t value, uint32_t time_ms) {
    if (self == NULL || item > SELFCAL_ANSWER_RESULT) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (!begin(self, ANSWER, SELFCAL_FRAME_ANSWER_ID, item, time_ms)) {
        return SELFCAL_BUSY;
    }
    self->item = item;
    self->answer = value;
    return SELFCAL_OK;
}

selfcal_status_t selfcal_telemetry_words(selfcal_telemetry_t *self, uint32_t id, const uint32_t word[], uint8_t count,
                                         uint32_t there, uint32_t time_ms) {
    if (self == NULL || word == NULL || count == 0U || count > 32U) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (!begin(self, WORDS, id, count, time_ms)) {
        return SELFCAL_BUSY;
    }
    self->word = word;
    self->answer = there;
    return SELFCAL_OK;
}

/* The parameter that a hypothesis has in a place of the wire, or NO_PARAMETER. */
static unsigned parameter_at(const selfcal_hypothesis_t *hypothesis, unsigned place) {
    switch (place) {
    case 0: return SELFCAL_N;
    case 1: return hypothesis->rho == NULL ? NO_PARAMETER : (unsigned)drift_parameter(hypothesis->law);
    default: return hypothesis->alpha == NULL ? NO_PARAMETER : SELFCAL_ALPHA;
    }
}

/* The value of an item of hypothesis `k`; false if it has none. */
static bool hypothesis_value(const selfcal_telemetry_t *self, uint8_t k, uint8_t item, uint32_t *value) {
    const selfcal_hypothesis_t *hypothesis = &self->model->hypothesis[k];
    const selfcal_posterior_t *p = &self->report->hypothesis[k];
    if (item == SELFCAL_HYPOTHESIS_PROBABILITY) {
        *value = float_bits(p->probability);
        return true;
    }
    if (item == SELFCAL_HYPOTHESIS_LN_EVIDENCE_DIFF) {
        *value = scaled_bits(p->ln_evidence - self->ln_best, SELFCAL_HYPOTHESIS_LN_EVIDENCE_DIFF_PER_UNIT);
        return true;
    }
    if (item == SELFCAL_HYPOTHESIS_N_FLAGS) {
        *value = 0;
        for (unsigned place = 0; place < SELFCAL_FRAME_PLACES; place++) {
            const unsigned parameter = parameter_at(hypothesis, place);
            *value |= parameter == NO_PARAMETER
                          ? 0U
                          : (uint32_t)p->parameter[parameter].flags << (place * SELFCAL_HYPOTHESIS_P1_FLAGS_SHIFT);
        }
        return true;
    }
    const unsigned at = item - (unsigned)SELFCAL_HYPOTHESIS_N_MEAN;
    const unsigned parameter = parameter_at(hypothesis, at / SELFCAL_FRAME_STATISTICS);
    if (parameter == NO_PARAMETER) {
        return false;
    }
    const selfcal_estimate_t *x = &p->parameter[parameter];
    const float statistic[SELFCAL_FRAME_STATISTICS] = {x->mean, x->median, x->sd, x->q05, x->q95};
    *value = float_bits(statistic[at % SELFCAL_FRAME_STATISTICS]);
    return true;
}

/* The value of an item of the coefficients; false if nothing is known of its column. */
static bool coefficient_value(const selfcal_telemetry_t *self, uint8_t item, uint32_t *value) {
    const selfcal_sent_coefficient_t *column = &self->coefficient[item / COLUMN_ITEMS];
    const float number[] = {column->mean, column->sd, column->probability};
    *value = float_bits(number[item % COLUMN_ITEMS]);
    return !isnan(column->mean);
}

/* Columns of which something is known. */
static uint32_t columns_told(const selfcal_telemetry_t *self) {
    uint32_t told = 0;
    for (uint8_t column = 0; column < columns(self); column++) {
        told += isnan(self->coefficient[column].mean) ? 0U : 1U;
    }
    return told;
}

static uint32_t health_value(const selfcal_telemetry_t *self) {
    const selfcal_counters_t *c = self->counters;
    const uint8_t axis = self->report->axis;
    return (c->not_finite[axis] != 0 ? 1U << SELFCAL_AXIS_NOT_FINITE_SHIFT : 0U) |
           (c->saturated[axis] != 0 ? 1U << SELFCAL_AXIS_SATURATED_SHIFT : 0U) |
           (c->stuck[axis] != 0 ? 1U << SELFCAL_AXIS_STUCK_SHIFT : 0U) |
           (c->gaps != 0 ? 1U << SELFCAL_AXIS_GAPS_SHIFT : 0U) |
           (c->blocks_lost != 0 ? 1U << SELFCAL_AXIS_BLOCKS_LOST_SHIFT : 0U) |
           (uint32_t)self->model->hypotheses << SELFCAL_AXIS_HYPOTHESES_SHIFT |
           columns_told(self) << SELFCAL_AXIS_COLUMNS_SHIFT |
           (uint32_t)c->outliers[axis] << SELFCAL_AXIS_OUTLIERS_SHIFT;
}

static uint32_t axis_value(const selfcal_telemetry_t *self, uint8_t item) {
    const selfcal_report_t *r = self->report;
    switch (item) {
    case SELFCAL_AXIS_TIME_MS: return self->time_ms;
    case SELFCAL_AXIS_COUNT: return r->n;
    case SELFCAL_AXIS_NOT_FINITE: return health_value(self);
    case SELFCAL_AXIS_LN_EVIDENCE: return float_bits((float)self->ln_best);
    case SELFCAL_AXIS_BIAS_MEAN: return float_bits(r->bias_mean);
    case SELFCAL_AXIS_BIAS_SD: return float_bits(r->bias_sd);
    default:
        return (self->time_ms & SELFCAL_AXIS_END_TIME_MS_MASK) << SELFCAL_AXIS_END_TIME_MS_SHIFT |
               (self->made + 1U) << SELFCAL_AXIS_END_ITEMS_SHIFT;
    }
}

static uint32_t adequacy_value(const selfcal_telemetry_t *self, uint8_t item) {
    switch (item) {
    case SELFCAL_ADEQUACY_ADEQUACY: return (uint32_t)self->judgement->state;
    case SELFCAL_ADEQUACY_SUSPICION: return (uint32_t)self->judgement->suspect;
    case SELFCAL_ADEQUACY_SUSPICION_SCORE: return float_bits(self->judgement->score);
    case SELFCAL_ADEQUACY_REASON: return (uint32_t)self->judgement->reason;
    case SELFCAL_ADEQUACY_JUDGED: return self->judgement->samples;
    case SELFCAL_ADEQUACY_TEMPERATURE_SPAN: return float_bits(self->judgement->temperature_span);
    case SELFCAL_ADEQUACY_CHANGE_COUNT: return self->judgement->changes;
    case SELFCAL_ADEQUACY_CHANGE: return (uint32_t)self->judgement->change.cause;
    case SELFCAL_ADEQUACY_CHANGE_SIZE: return float_bits(self->judgement->change.size);
    default: return float_bits(self->judgement->change.ago_s);
    }
}

/* The value of an item of the part of the report under way; false if it has none. */
static bool report_value(const selfcal_telemetry_t *self, uint8_t item, uint32_t *value) {
    const uint8_t hypotheses = self->model->hypotheses;
    if (self->part > 0U && self->part <= hypotheses) {
        return hypothesis_value(self, (uint8_t)(self->part - 1U), item, value);
    }
    if (self->part == hypotheses + 1U) {
        return coefficient_value(self, item, value);
    }
    if (self->part == hypotheses + 2U) {
        *value = adequacy_value(self, item);
        return true;
    }
    *value = axis_value(self, item);
    return true;
}

static uint32_t sum_of_axes(const selfcal_telemetry_t *self, const uint32_t count[]) {
    uint64_t sum = 0;
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        sum += count[axis];
    }
    return held_count(sum);
}

/* Offset of the axis that has message `message`, as a number; 0 if none has. */
static uint32_t offset_value(const selfcal_telemetry_t *self, uint8_t message) {
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        if (self->message[axis] == message) {
            return float_bits(self->module->offset[axis]);
        }
    }
    return 0U;
}

/* A reason by axis, above what else the item holds. */
static uint32_t reason_bits(const selfcal_telemetry_t *self, const selfcal_reason_t reason[]) {
    uint32_t bits = 0;
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        bits |= (uint32_t)reason[axis] << (SELFCAL_STATUS_REASON_GX_SHIFT + REASON_BITS * self->message[axis]);
    }
    return bits;
}

static uint32_t retired_value(const selfcal_telemetry_t *self) {
    uint32_t axes = reason_bits(self, self->module->reason);
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        axes |= (self->module->retired >> axis & 1U) << self->message[axis];
    }
    return axes;
}

static uint32_t module_value(const selfcal_telemetry_t *self, uint8_t item) {
    const selfcal_module_t *module = self->module;
    switch (item) {
    case SELFCAL_STATUS_RESET_CAUSE: return module->reset_cause;
    case SELFCAL_STATUS_FAULT_ADDRESS: return module->fault_address;
    case SELFCAL_STATUS_CLOCK: return module->clock;
    case SELFCAL_STATUS_SENSOR_STATE: return module->sensor_state;
    case SELFCAL_STATUS_SENSOR_FAULT: return module->sensor_fault;
    case SELFCAL_STATUS_SENSOR_FAULT_COUNT: return module->sensor_fault_count;
    case SELFCAL_STATUS_SENSOR_DIAGNOSIS: return module->sensor_diagnosis;
    case SELFCAL_STATUS_SENSOR_STALE_COUNT: return module->sensor_stale_count;
    case SELFCAL_STATUS_SENSOR_ALARM_COUNT: return module->sensor_alarm_count;
    case SELFCAL_STATUS_SENSOR_DAMAGED_COUNT: return module->sensor_damaged_count;
    case SELFCAL_STATUS_SENSOR_ANOMALY_COUNT: return module->sensor_anomaly_count;
    case SELFCAL_STATUS_SENSOR_OVERRUN_COUNT: return module->sensor_overrun_count;
    case SELFCAL_STATUS_FRAMES_DROPPED: return module->frames_dropped;
    case SELFCAL_STATUS_BUS_OFF_COUNT: return module->bus_off_count;
    case SELFCAL_STATUS_STATE_FOUND: return module->state_found;
    case SELFCAL_STATUS_STATE_REFUSED: return module->state_refused;
    case SELFCAL_STATUS_STATE_SAVES: return module->state_saves;
    case SELFCAL_STATUS_STATE_SAVE_FAILURES: return module->state_save_failures;
    case SELFCAL_STATUS_MOTION: return module->motion;
    case SELFCAL_STATUS_GATE_ALARM_COUNT: return module->gate_alarm_count;
    case SELFCAL_STATUS_AXES_RETIRED: return retired_value(self);
    case SELFCAL_STATUS_COMMAND_COUNT: return module->command_count;
    case SELFCAL_STATUS_COMMAND_REFUSED_COUNT: return module->command_refused_count;
    default: return offset_value(self, (uint8_t)(item - SELFCAL_STATUS_OFFSET_GX)); /* to SELFCAL_STATUS_OFFSET_AZ */
    }
}

static uint32_t status_value(const selfcal_telemetry_t *self, uint8_t item) {
    const selfcal_counters_t *c = self->counters;
    switch (item) {
    case SELFCAL_STATUS_TIME_MS: return self->time_ms;
    case SELFCAL_STATUS_WIRE_VERSION: return SELFCAL_FRAMES_VERSION;
    case SELFCAL_STATUS_MODEL_ID: return self->model->id;
    case SELFCAL_STATUS_BANK_INTERVAL: return float_bits(self->model->dt_s);
    case SELFCAL_STATUS_BANK_BLOCK: return self->model->block;
    case SELFCAL_STATUS_STATE:
        return self->state == SELFCAL_FINISHED ? SELFCAL_STATUS_STATE_FINISHED : SELFCAL_STATUS_STATE_RUNNING;
    case SELFCAL_STATUS_REPORT: return self->report_number;
    case SELFCAL_STATUS_SAMPLES: return held_count(c->samples);
    case SELFCAL_STATUS_MISSING: return held_count(c->missing);
    case SELFCAL_STATUS_GAP_COUNT: return c->gaps;
    case SELFCAL_STATUS_BLOCKS_LOST_COUNT: return c->blocks_lost;
    case SELFCAL_STATUS_BLOCKS_PART_COUNT: return c->blocks_part;
    case SELFCAL_STATUS_NOT_FINITE_COUNT: return sum_of_axes(self, c->not_finite);
    case SELFCAL_STATUS_SATURATED_COUNT: return sum_of_axes(self, c->saturated);
    case SELFCAL_STATUS_STUCK_COUNT: return sum_of_axes(self, c->stuck);
    case SELFCAL_STATUS_BLOCKS_MOVING_COUNT: return c->blocks_moving;
    case SELFCAL_STATUS_FRAMES_SENT: return self->frames;
    default: return self->module != NULL ? module_value(self, item) : 0U;
    }
}

/* The value of an item of the corrected sample; false if its axis has none. */
static bool corrected_value(const selfcal_telemetry_t *self, uint8_t item, uint32_t *value) {
    const selfcal_corrected_t *corrected = self->corrected;
    if (item == SELFCAL_CORRECTED_TIME_MS || item == SELFCAL_CORRECTED_MOTION) {
        *value = item == SELFCAL_CORRECTED_TIME_MS ? self->time_ms
                                                   : corrected->motion | reason_bits(self, corrected->reason);
        return true;
    }
    const bool of_sd = item >= SELFCAL_CORRECTED_SD_GX;
    const unsigned message =
        item - (of_sd ? (unsigned)SELFCAL_CORRECTED_SD_GX : (unsigned)SELFCAL_CORRECTED_CORRECTED_GX);
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        if (self->message[axis] == message) {
            *value = float_bits(of_sd ? corrected->sd[axis] : corrected->value[axis]);
            return isfinite(corrected->sd[axis]);
        }
    }
    return false;
}

static void pack(selfcal_frame_t *frame, uint16_t id, uint8_t item, uint32_t value, uint32_t counter,
                 uint32_t time_ms) {
    uint64_t bits = value;
    bits |= (uint64_t)(item & SELFCAL_FRAME_ITEM_MASK) << SELFCAL_FRAME_ITEM_SHIFT;
    bits |= (uint64_t)(counter & SELFCAL_FRAME_COUNTER_MASK) << SELFCAL_FRAME_COUNTER_SHIFT;
    bits |= (uint64_t)((time_ms / 1000U) & SELFCAL_FRAME_TIME_MASK) << SELFCAL_FRAME_TIME_SHIFT;

    frame->id = id;
    frame->length = sizeof frame->data;
    uint8_t covered[10] = {(uint8_t)(id >> 8), (uint8_t)id, sizeof frame->data};
    for (unsigned i = 0; i < 7; i++) {
        covered[3 + i] = (uint8_t)(bits >> (8U * i)); /* the crc's bits are still 0 */
    }
    bits |= (uint64_t)selfcal_crc12(covered, sizeof covered) << SELFCAL_FRAME_CRC_SHIFT;
    for (unsigned i = 0; i < sizeof frame->data; i++) {
        frame->data[i] = (uint8_t)(bits >> (8U * i));
    }
}

bool selfcal_telemetry_next(selfcal_telemetry_t *self, selfcal_frame_t *frame) {
    if (self->items == 0) {
        return false;
    }
    do {
        while (self->item < self->items) {
            const uint8_t item = self->item++;
            uint32_t value = self->answer;
            bool has = true;
            switch (self->source) {
            case STATUS: value = status_value(self, item); break;
            case REPORT: has = report_value(self, item, &value); break;
            case CORRECTED: has = corrected_value(self, item, &value); break;
            case WORDS:
                has = item == 0U || (self->answer >> (item - 1U) & 1U) != 0U;
                value = item == 0U ? self->time_ms : self->word[item - 1U];
                break;
            default: break;
            }
            if (has) {
                pack(frame, self->id, item, value, self->frames, self->time_ms);
                self->frames++;
                self->made++;
                return true;
            }
        }
    } while (next_part(self));
    self->items = 0;
    return false;
}
