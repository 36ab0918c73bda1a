/* libFuzzer on the public interface: the input is a model and a list of calls with their arguments.
 *
 * After every call: no report of the sanitizers, no failed SELFCAL_ASSERT, counters not running backwards, reports that
 * are probability laws. After every LOOK_EVERY-th, and wherever the state is about to be replaced: selfcal_check()
 * content (what is broken stays broken). A twin, once restored from a snapshot, gets the same calls and must stay equal
 * bit for bit. An execution is fast: small grids and batches (see the Makefile), seldom two sums in a model, records
 * that are short where the nodes are many, and by a hash of the input only some executions make whole reports, save
 * snapshots, or push long records. */
#include <math.h>
#include <sanitizer/asan_interface.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "selfcal.h"

#include "../common/named_laws.h"

enum { NODES_A_GRID = 6, NODES_MAX = SELFCAL_HYPOTHESES_MAX * NODES_A_GRID * NODES_A_GRID };
enum { STEPS_MAX = 100000, CALLS_MAX = 200, LOOK_EVERY = 32 };
/* for bank samples, some 0.1 ms; but a batch and a part of the next are had by all */
enum { EFFORT = 1500, SAMPLES_MIN = 10 };
#define MORE                                                                                                           \
    (SELFCAL_REGRESSORS_SIZE(NODES_MAX, SELFCAL_AXES_MAX, SELFCAL_REGRESSORS_MAX) +                                    \
     SELFCAL_TERMS_SIZE(NODES_MAX, SELFCAL_AXES_MAX, SELFCAL_REGRESSORS_MAX))
#define BYTES_MAX (SELFCAL_SNAPSHOT_MAX(SELFCAL_SIZE(NODES_MAX, SELFCAL_AXES_MAX)) + MORE)

#define LENGTH(array) (sizeof(array) / sizeof((array)[0]))

#define HOLDS(condition)                                                                                               \
    do {                                                                                                               \
        if (!(condition)) {                                                                                            \
            (void)fprintf(stderr, "%s:%d: %s\n", __FILE__, __LINE__, #condition);                                      \
            abort();                                                                                                   \
        }                                                                                                              \
    } while (0)

typedef struct {
    const uint8_t *at, *end;
} input_t;

typedef struct {
    selfcal_t self;
    selfcal_wide_t memory[(SELFCAL_SIZE(NODES_MAX, SELFCAL_AXES_MAX) + MORE) / sizeof(selfcal_wide_t) + 1U];
} bank_t;

typedef struct {
    uint8_t bytes[BYTES_MAX];
    size_t length, fail_at;
} store_t;

static selfcal_axis_t axis_table[SELFCAL_AXES_MAX];
static const selfcal_prior_t some_priors[SELFCAL_PARAMETERS] = {{-6.9F, -0.7F, SELFCAL_LOG_UNIFORM, false},
                                                                {-10.0F, -3.0F, SELFCAL_LOG_UNIFORM, false},
                                                                {-7.0F, -1.0F, SELFCAL_LOG_UNIFORM, false},
                                                                {-2.0F, 2.0F, SELFCAL_LOG_UNIFORM, false}};
static selfcal_prior_t of_ratio[SELFCAL_AXES_MAX][SELFCAL_PARAMETERS];
static selfcal_hypothesis_t hypothesis_table[SELFCAL_HYPOTHESES_MAX];
static selfcal_law_t law_table[NAMED_LAWS];
static selfcal_real_t fit[NODES_A_GRID * NODES_A_GRID];
static const selfcal_grid_t grid = {NODES_A_GRID, fit};
static selfcal_model_t model;
static selfcal_regressors_t regressors;
static selfcal_forgetting_t forgetting;
static float reference[SELFCAL_REGRESSORS_MAX], coefficient_sd[SELFCAL_AXES_MAX * SELFCAL_REGRESSORS_MAX];
static float coefficient_mean[SELFCAL_AXES_MAX * SELFCAL_REGRESSORS_MAX];
static float values[SELFCAL_REGRESSORS_MAX]; /* of the regressors, as they come with the next sample */

static bank_t bank, twin;
static bool twinned;   /* the twin is at the bank's state */
static bool tampered;  /* the bank comes from a snapshot that no bank wrote: numbers may overflow, memory may not */
static bool reporting; /* a report is under way */
static size_t in_use;  /* bytes of their memory */
static unsigned pushes, effort, steps, snapshots; /* left: long inputs, whole reports and snapshots are slow */
static unsigned sample_effort;                    /* of effort, for a bank sample */
/* left: looks that take all nodes through a part of a batch, reports that come to an end */
static unsigned flushes, reports;
static bool moved; /* there may be such a part */
static selfcal_counters_t before;
static uint32_t count_before;
static selfcal_work_t work, twin_work;
static selfcal_report_t report, twin_report;
static selfcal_gate_t gate;
static bool has_gate;
static selfcal_telemetry_t telemetry;
static bool has_telemetry;
static uint32_t crc_table[256];

/* --- input --- */

static uint8_t byte(input_t *in) {
    return in->at < in->end ? *in->at++ : 0U;
}

static uint64_t bits(input_t *in, int bytes) {
    uint64_t value = 0;
    for (int i = 0; i < bytes; i++) {
        value |= (uint64_t)byte(in) << (8 * i);
    }
    return value;
}

static float any_float(input_t *in) {
    const uint32_t pattern = (uint32_t)bits(in, 4);
    float value;
    memcpy(&value, &pattern, sizeof value);
    return value;
}

/* 2^-12 to 2^12 or so, either sign, zero among them. */
static float moderate(input_t *in) {
    const uint8_t b = byte(in);
    return ldexpf((float)((b & 15) - 8), (b >> 4) - 8);
}

/* --- model --- */

/* Node values to coefficients of the quintic without inner knots: the inverse of the Bernstein polynomials at k/5. */
static void make_fit(void) {
    enum { N = NODES_A_GRID };
    double a[N][2 * N];
    for (int i = 0; i < N; i++) {
        double choose = 1.0;
        for (int k = 0; k < N; k++) {
            a[i][k] = choose * pow(i / 5.0, k) * pow(1.0 - i / 5.0, N - 1 - k);
            a[i][N + k] = i == k ? 1.0 : 0.0;
            choose = choose * (N - 1 - k) / (k + 1);
        }
    }
    for (int i = 0; i < N; i++) { /* totally positive: no pivot is zero */
        for (int row = 0; row < N; row++) {
            const double factor = row == i ? 1.0 - 1.0 / a[i][i] : a[row][i] / a[i][i];
            for (int k = 2 * N - 1; k >= 0; k--) {
                a[row][k] -= factor * a[i][k];
            }
        }
    }
    for (int i = 0; i < N; i++) {
        for (int k = 0; k < N; k++) {
            fit[i * N + k] = (selfcal_real_t)a[i][N + k];
        }
    }
}

static void make_model(input_t *in, bool any_sums) {
    static const float intervals[] = {1.0F, 0.1F, 1.0F / 819.2F, 100.0F};
    static const uint32_t blocks[] = {1, 2, 3, 8};
    static const float priors[][2] = {{-7.0F, -0.7F}, {-14.0F, 4.0F}, {-1.0F, 1.0F}};
    /* bits: flicker, moving average, walk and Markov. 36 nodes each: models of several are rare */
    static const uint8_t sums[] = {0, 1, 2, 1, 4, 0, 2, 4};
    const uint8_t shape = byte(in), kind = byte(in), limits = byte(in);
    memset(&model, 0, sizeof model);
    model.id = 7;
    model.dt_s = intervals[limits & 3U];
    model.block = blocks[shape >> 2 & 3U];
    model.axes = (uint8_t)(1U + shape % SELFCAL_AXES_MAX);
    model.axis = axis_table;
    model.hypothesis = hypothesis_table;
    model.states = &selfcal_states_code;
    for (unsigned axis = 0; axis < SELFCAL_AXES_MAX; axis++) {
        memcpy(of_ratio[axis], some_priors, sizeof some_priors);
        selfcal_axis_t *a = &axis_table[axis];
        for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
            const unsigned set = kind >> 3 & 3U;
            if (set < 3U) {
                a->prior[p].ln_min = priors[set][0];
                a->prior[p].ln_max = priors[set][1];
            } else {
                a->prior[p].ln_min = moderate(in);
                a->prior[p].ln_max = moderate(in);
            }
            a->prior[p].law = (selfcal_prior_law_t)((kind >> 5 & 1U) * (1U + (limits >> 4 & 1U)));
        }
        a->bias_sd = (kind >> 6 & 1U) != 0U ? 10.0F : 1e-3F;
        a->range = (limits >> 2 & 1U) != 0U ? 5.0F : 0.0F;
        a->stuck_limit = (limits >> 3 & 1U) != 0U ? 3U : 0U;
    }
    unsigned laws = (kind & 7U) == 0U ? 7U : kind & 7U;
    const unsigned more = limits >> 4 & 7U;
    const bool all = any_sums && shape >> 5 == 6U;
    if (SELFCAL_TERMS_MAX > 1) {
        laws |= (all ? more : sums[more]) << FLICKER;
    }
    memcpy(law_table, named_law, sizeof law_table);
    law_table[WALK_AND_MARKOV].term[1].bandwidth = 1.0F / (((limits >> 7 & 1U) != 0U ? 0.2F : 100.0F) * model.dt_s);
    for (unsigned law = 0; law < NAMED_LAWS; law++) {
        if ((laws >> law & 1U) != 0U) {
            selfcal_hypothesis_t *h = &hypothesis_table[model.hypotheses++];
            h->law = &law_table[law];
            h->ln_probability = -1.0F;
            h->rho = law != CONSTANT ? &grid : NULL;
            h->alpha = law >= GAUSS_MARKOV ? &grid : NULL;
            h->prior = law >= MOVING_AVERAGE ? &of_ratio[0][0] : NULL;
            model.nodes =
                (uint16_t)(model.nodes + (h->rho != NULL ? NODES_A_GRID : 1) * (h->alpha != NULL ? NODES_A_GRID : 1));
        }
    }
    if ((kind >> 7 & 1U) != 0U) {
        regressors.code = &selfcal_regressors_code;
        regressors.count = (uint8_t)(1U + (shape >> 4 & 1U) % SELFCAL_REGRESSORS_MAX);
        regressors.reference = reference;
        regressors.coefficient_sd = coefficient_sd;
        regressors.coefficient_mean = coefficient_mean;
        for (unsigned k = 0; k < SELFCAL_REGRESSORS_MAX; k++) {
            reference[k] = 20.0F;
            values[k] = 20.0F;
        }
        for (unsigned k = 0; k < LENGTH(coefficient_sd); k++) {
            coefficient_sd[k] = k % 4U == 3U ? 0.0F : 0.01F;
            coefficient_mean[k] = k % 2U == 1U ? 0.0F : 0.02F;
        }
        model.regressors = &regressors;
    }
    if (all ? (more & 3U) == 3U : more == 3U || more == 5U || more == 7U) {
        forgetting.code = &selfcal_forgetting_code;
        forgetting.half_life_s = ldexpf(model.dt_s, 3 + 3 * (limits >> 6)); /* 8 to 4096 bank intervals */
        model.forgetting = &forgetting;
    }
    if (shape >> 5 != 7U) {
        return;
    }
    /* something is wrong with this one */
    switch (byte(in) % 25U) {
    case 23: {
        selfcal_term_t *term = &law_table[byte(in) % NAMED_LAWS].term[byte(in) % SELFCAL_LAW_TERMS];
        term->kind = (byte(in) & 1U) != 0U ? SELFCAL_WALK : SELFCAL_MARKOV;
        term->deviation = any_float(in);
        term->bandwidth = any_float(in);
        term->stated = (byte(in) & 1U) != 0U;
        term->by_ratio = (byte(in) & 1U) != 0U;
        break;
    }
    case 24: law_table[byte(in) % NAMED_LAWS].terms = byte(in) & 7U; break;
    case 0: model.dt_s = any_float(in); break;
    case 1: model.block = (uint32_t)bits(in, 4); break;
    case 2: model.axes = byte(in); break;
    case 3: model.hypotheses = byte(in); break;
    case 4: model.nodes = (uint16_t)bits(in, 2); break;
    case 5: model.axis = NULL; break;
    case 6: model.hypothesis = NULL; break;
    case 7: axis_table[0].bias_sd = any_float(in); break;
    case 8: axis_table[0].range = any_float(in); break;
    case 9: axis_table[0].stuck_limit = byte(in); break;
    case 10: axis_table[0].prior[byte(in) % SELFCAL_PARAMETERS].ln_min = any_float(in); break;
    case 11: axis_table[0].prior[byte(in) % SELFCAL_PARAMETERS].ln_max = any_float(in); break;
    case 12: {
        const unsigned other = byte(in) & 7U;
        hypothesis_table[0].law = other < NAMED_LAWS ? &law_table[other] : NULL;
        break;
    }
    case 13: hypothesis_table[0].rho = hypothesis_table[0].rho == NULL ? &grid : NULL; break;
    case 14: hypothesis_table[0].alpha = hypothesis_table[0].alpha == NULL ? &grid : NULL; break;
    case 15: regressors.count = byte(in); break;
    case 16: regressors.reference = NULL; break;
    case 17: reference[0] = any_float(in); break;
    case 18: *((byte(in) & 1U) != 0U ? coefficient_sd : coefficient_mean) = any_float(in); break;
    case 19: forgetting.half_life_s = any_float(in); break;
    case 20: forgetting.code = NULL; break;
    case 21: of_ratio[0][byte(in) % SELFCAL_PARAMETERS].ln_min = any_float(in); break;
    case 22: of_ratio[0][byte(in) % SELFCAL_PARAMETERS].ln_max = any_float(in); break;
    default:
        hypothesis_table[0].ln_probability = any_float(in);
        law_table[WALK_AND_MARKOV].term[1].bandwidth = any_float(in);
        break;
    }
}

/* --- what holds --- */

static bool append(void *context, const void *bytes, size_t count) {
    store_t *store = context;
    if (store->fail_at != 0U && store->length + count >= store->fail_at) {
        return false;
    }
    HOLDS(store->length + count <= sizeof store->bytes);
    memcpy(store->bytes + store->length, bytes, count);
    store->length += count;
    return true;
}

static selfcal_status_t save(const bank_t *from, store_t *store) {
    store->length = 0;
    store->fail_at = 0;
    const selfcal_status_t status = selfcal_save(&from->self, append, store);
    HOLDS(status != SELFCAL_OK || store->length == selfcal_snapshot_size(&from->self));
    return status;
}

static selfcal_status_t restore(bank_t *to, const store_t *store) {
    return selfcal_restore(&to->self, &model, to->memory, in_use, store->bytes, store->length);
}

/* Nodes of the laws that are no sums. */
static size_t plain_nodes(void) {
    size_t nodes = 0;
    for (uint8_t h = 0; h < model.hypotheses; h++) {
        const selfcal_hypothesis_t *of = &hypothesis_table[h];
        nodes += selfcal_law_is_sum(of->law)
                     ? 0U
                     : (of->rho != NULL ? NODES_A_GRID : 1U) * (of->alpha != NULL ? NODES_A_GRID : 1U);
    }
    return nodes;
}

/* What a bank sample costs, in some 0.1 us: each node's gains and the series it filters, those of sums to twice the
 * digits. */
static unsigned effort_of_sample(void) {
    const unsigned columns = 1U + model.axes + (model.regressors != NULL ? regressors.count : 0U),
                   plain = (unsigned)plain_nodes();
    return (model.nodes - plain) * (3U + columns) + plain * (2U + columns) / (model.regressors != NULL ? 2U : 4U) + 1U;
}

/* Bytes of the bank's memory that this model needs. */
static size_t needed(void) {
    const size_t columns = model.regressors != NULL ? regressors.count : 0U;
    return SELFCAL_SIZE(model.nodes, model.axes) + SELFCAL_REGRESSORS_SIZE(model.nodes, model.axes, columns) +
           SELFCAL_TERMS_SIZE(model.nodes - plain_nodes(), model.axes, columns);
}

/* What lies beyond is out of bounds. */
static void fence(bank_t *of) {
    uint8_t *memory = (uint8_t *)of->memory;
    ASAN_UNPOISON_MEMORY_REGION(memory, in_use);
    ASAN_POISON_MEMORY_REGION(memory + in_use, sizeof of->memory - in_use);
}

/* All but the pointers; padding is clear in both. */
static void equal_banks(const bank_t *one, const bank_t *two) {
    const size_t from = offsetof(selfcal_t, n);
    HOLDS(memcmp((const uint8_t *)&one->self + from, (const uint8_t *)&two->self + from, sizeof(selfcal_t) - from) ==
          0);
    HOLDS(memcmp(one->memory, two->memory, SELFCAL_SIZE(model.nodes, model.axes)) == 0);
    if (model.regressors != NULL) {
        const uint8_t *a = (const void *)one->self.columns->column, *b = (const void *)two->self.columns->column;
        const size_t all =
            SELFCAL_REGRESSORS_SIZE(model.nodes, model.axes, regressors.count) - 7U - sizeof(selfcal_columns_t);
        HOLDS(memcmp(a, b, all) == 0);
    }
    if (one->self.terms != NULL) {
        const uint8_t *a = (const void *)one->self.terms->node, *b = (const void *)two->self.terms->node;
        const size_t nodes = SELFCAL_TERMS_SIZE(1, model.axes, 0) - 7U - sizeof(selfcal_terms_t); /* of one node */
        HOLDS(memcmp(a, b, nodes * (one->self.model->nodes - plain_nodes())) == 0);
    }
}

static bool grown(uint32_t before_, uint32_t now) {
    return now >= before_;
}

static void check_state(void) {
    HOLDS(tampered || selfcal_check(&bank.self) == SELFCAL_OK);
}

static void check_counters(void) {
    const selfcal_counters_t now = *selfcal_counters(&bank.self);
    if (tampered) {
        return;
    }
    HOLDS(now.samples >= before.samples && now.missing >= before.missing && grown(before.gaps, now.gaps) &&
          grown(before.blocks_lost, now.blocks_lost) && grown(before.blocks_part, now.blocks_part) &&
          grown(before.blocks_moving, now.blocks_moving));
    for (unsigned axis = 0; axis < model.axes; axis++) {
        HOLDS(grown(before.not_finite[axis], now.not_finite[axis]) &&
              grown(before.saturated[axis], now.saturated[axis]) && grown(before.stuck[axis], now.stuck[axis]));
        HOLDS(isfinite(selfcal_offset(&bank.self, (uint8_t)axis)));
        HOLDS(!(selfcal_within_sd(&bank.self, (uint8_t)axis) < 0.0F));
    }
    HOLDS(grown(count_before, selfcal_count(&bank.self)));
    before = now;
    count_before = selfcal_count(&bank.self);
}

static void check_report(void) {
    float sum = 0.0F;
    bool outside = true; /* the priors leave nothing of any hypothesis: all probabilities are NaN */
    for (unsigned h = 0; h < model.hypotheses; h++) {
        outside = outside && report.hypothesis[h].ln_evidence == (selfcal_wide_t)-INFINITY;
    }
    for (unsigned h = 0; h < model.hypotheses; h++) {
        const selfcal_posterior_t *p = &report.hypothesis[h];
        sum += p->probability;
        HOLDS(outside ? isnan(p->probability) : p->probability >= 0.0F && p->probability <= 1.0F);
        for (unsigned k = 0; k < SELFCAL_PARAMETERS; k++) {
            const selfcal_estimate_t *e = &p->parameter[k];
            HOLDS(isnan(e->mean) || (e->mean > 0.0F && e->sd >= 0.0F && e->q05 <= e->median && e->median <= e->q95));
        }
        HOLDS(isnan(p->bias_sd) || p->bias_sd >= 0.0F);
    }
    HOLDS(outside || fabsf(sum - 1.0F) < 1e-5F);
    HOLDS(outside || (isfinite(report.bias_mean) && report.bias_sd >= 0.0F));
}

static void check_frames(void) {
    selfcal_frame_t frame;
    unsigned frames = 0;
    while (selfcal_telemetry_next(&telemetry, &frame)) {
        HOLDS(frame.length == 8U && frame.id < 0x800U && ++frames < 200U);
    }
}

static void check_motion(selfcal_motion_t motion) {
    HOLDS(motion == SELFCAL_RESTING || motion == SELFCAL_MOVING);
    HOLDS(gate.state == motion && gate.counters.alarms <= gate.counters.windows);
}

/* --- calls --- */

static void push(const float sample[]) {
    if (pushes == 0U || effort == 0U) {
        return;
    }
    pushes--;
    moved = true;
    const uint32_t samples = selfcal_count(&bank.self);
    HOLDS(selfcal_push(&bank.self, sample) == SELFCAL_OK || model.regressors != NULL);
    if (model.regressors != NULL) {
        HOLDS(selfcal_push_with(&bank.self, sample, values) == SELFCAL_OK);
    }
    if (twinned) {
        HOLDS(selfcal_push_with(&twin.self, sample, values) == SELFCAL_OK);
    }
    values[0] += 0.1F;
    if (has_gate) {
        check_motion(selfcal_gate_push(&gate, sample));
    }
    if (selfcal_count(&bank.self) != samples) {
        effort -= effort < sample_effort ? effort : sample_effort;
    }
}

static void push_moderate(input_t *in) {
    float sample[SELFCAL_AXES_MAX];
    for (unsigned axis = 0; axis < SELFCAL_AXES_MAX; axis++) {
        sample[axis] = axis < model.axes ? 1.0F + 0.01F * moderate(in) : 0.0F;
    }
    push(sample);
}

static void any_sample(input_t *in, float sample[]) {
    for (unsigned axis = 0; axis < SELFCAL_AXES_MAX; axis++) {
        sample[axis] = axis < model.axes ? any_float(in) : NAN;
    }
}

static void push_any(input_t *in) {
    float sample[SELFCAL_AXES_MAX];
    any_sample(in, sample);
    push(sample);
}

static void push_many(input_t *in) {
    uint32_t state = 1U + byte(in);
    const uint8_t many = byte(in);
    const float level = moderate(in), scale = moderate(in);
    for (unsigned i = 0; i <= many; i++) {
        float sample[SELFCAL_AXES_MAX];
        for (unsigned axis = 0; axis < SELFCAL_AXES_MAX; axis++) {
            state = state * 1664525U + 1013904223U;
            sample[axis] = level + scale * (float)(state >> 8) / 16777216.0F;
        }
        push(sample);
    }
}

static void set_values(input_t *in) {
    const uint8_t how = byte(in);
    for (unsigned k = 0; k < SELFCAL_REGRESSORS_MAX; k++) {
        values[k] = how == 255U ? any_float(in) : moderate(in);
    }
}

static void skip(uint64_t count) {
    moved = true;
    HOLDS(selfcal_skip(&bank.self, count) == SELFCAL_OK);
    if (twinned) {
        HOLDS(selfcal_skip(&twin.self, count) == SELFCAL_OK);
    }
    if (has_gate) {
        check_motion(selfcal_gate_skip(&gate, count));
    }
}

static void moving(void) {
    moved = true;
    HOLDS(selfcal_moving(&bank.self) == SELFCAL_OK);
    if (twinned) {
        HOLDS(selfcal_moving(&twin.self) == SELFCAL_OK);
    }
}

static void push_in_motion(input_t *in) {
    float sample[SELFCAL_AXES_MAX];
    any_sample(in, sample);
    moved = true;
    HOLDS(selfcal_push_moving(&bank.self, sample) == SELFCAL_OK);
    if (twinned) {
        HOLDS(selfcal_push_moving(&twin.self, sample) == SELFCAL_OK);
    }
}

static void shift(input_t *in) {
    const uint8_t which = byte(in);
    const float amount = (which & 0x80U) != 0U ? any_float(in) : moderate(in);
    const uint8_t axis = which & 3U;
    const selfcal_status_t status = selfcal_shift(&bank.self, axis, amount);
    HOLDS(status == SELFCAL_OK || status == SELFCAL_BAD_ARGUMENT || status == SELFCAL_AXIS_RETIRED);
    HOLDS(!twinned || selfcal_shift(&twin.self, axis, amount) == status);
    reporting = false;
}

static void rate(input_t *in) {
    const uint8_t how = byte(in);
    const uint32_t block = how == 255U ? (uint32_t)bits(in, 4) : how & 15U;
    const float ratio = how == 255U ? any_float(in) : ldexpf(1.0F, (how >> 4) - 8);
    const selfcal_status_t status = selfcal_rate(&bank.self, block, ratio);
    HOLDS(status == SELFCAL_OK || status == SELFCAL_BAD_ARGUMENT);
    HOLDS(!twinned || selfcal_rate(&twin.self, block, ratio) == status);
}

static void look_at_node(input_t *in) {
    const uint8_t axis = byte(in) % (SELFCAL_AXES_MAX + 1U);
    const uint16_t index = (uint16_t)(byte(in) % (model.nodes + 2U)); /* seldom out of range */
    selfcal_node_view_t view;
    selfcal_wide_t ln_p = 0.0, sigma;
    const uint8_t odd = byte(in);
    if (odd == 255U) {
        const uint64_t pattern = bits(in, 8);
        memcpy(&sigma, &pattern, sizeof sigma);
    } else {
        sigma = ldexp(1.0 + odd % 16, odd / 16 - 12);
    }
    if (moved && flushes == 0U) {
        return;
    }
    flushes -= moved ? 1U : 0U;
    moved = false;
    const selfcal_status_t status = selfcal_node(&bank.self, axis, index, &view);
    HOLDS(status == SELFCAL_OK || status == SELFCAL_TOO_SHORT || status == SELFCAL_AXIS_RETIRED ||
          status == SELFCAL_BAD_ARGUMENT);
    HOLDS((status == SELFCAL_BAD_ARGUMENT) == (axis >= model.axes || index >= model.nodes));
    if (twinned) {
        HOLDS(selfcal_node(&twin.self, axis, index, &view) == status);
    }
    const selfcal_status_t same = selfcal_log_likelihood(&bank.self, axis, index, sigma, &ln_p);
    HOLDS(same == status || same == SELFCAL_BAD_ARGUMENT);
    if (same == SELFCAL_OK && odd != 255U && !tampered) {
        HOLDS(isfinite(ln_p) && view.a > 0.0 && view.c >= 0.0 && view.drift_var >= 0.0);
    }
}

static void report_begin(input_t *in) {
    if (reports == 0U) {
        return;
    }
    const uint8_t axis = byte(in) % (SELFCAL_AXES_MAX + 1U);
    const uint8_t mask = model.regressors != NULL ? byte(in) & 3U : 0U;
    const selfcal_status_t status = selfcal_report_begin_subset(&work, &bank.self, axis, mask, NULL, &report);
    HOLDS(status == SELFCAL_OK || status == SELFCAL_TOO_SHORT || status == SELFCAL_AXIS_RETIRED ||
          status == SELFCAL_BAD_ARGUMENT);
    HOLDS((status == SELFCAL_BAD_ARGUMENT) == (axis >= model.axes) || mask != 0U);
    if (twinned) {
        HOLDS(selfcal_report_begin_subset(&twin_work, &twin.self, axis, mask, NULL, &twin_report) == status);
    }
    reporting = status == SELFCAL_OK;
}

static void report_steps(unsigned wanted) {
    selfcal_status_t status = SELFCAL_BUSY;
    for (; reporting && wanted > 0U && steps > 0U && status == SELFCAL_BUSY; wanted--, steps--) {
        status = selfcal_report_step(&work, &report);
        HOLDS(status == SELFCAL_BUSY || status == SELFCAL_OK || status == SELFCAL_OVERTAKEN ||
              status == SELFCAL_AXIS_RETIRED || (status == SELFCAL_TOO_SHORT && model.forgetting != NULL));
        HOLDS(!twinned || selfcal_report_step(&twin_work, &twin_report) == status);
    }
    if (status != SELFCAL_BUSY) {
        reporting = false;
        HOLDS(selfcal_report_step(&work, &report) == SELFCAL_BAD_ARGUMENT || status != SELFCAL_OK);
    }
    if (status == SELFCAL_OK) {
        reports--;
        HOLDS(!twinned || memcmp(&report, &twin_report, sizeof report) == 0);
        if (!tampered) {
            check_report();
        }
        if (has_telemetry &&
            selfcal_telemetry_report(&telemetry, &report, selfcal_counters(&bank.self), 1000U) == SELFCAL_OK) {
            check_frames();
        }
    }
}

static void begin_gate(input_t *in) {
    static const float alarm[] = {0.0F, 1e-6F, 1e-3F, 0.1F, -1.0F, 0.2F, NAN, INFINITY};
    selfcal_gate_config_t config;
    memset(&config, 0, sizeof config);
    const uint8_t how = byte(in), more = byte(in);
    config.axes = model.axes;
    config.window = how & 15U;
    config.false_alarm = alarm[how >> 4 & 7U];
    config.hold = more & 3U;
    config.settle = more >> 2 & 7U;
    config.memory = more >> 5;
    for (unsigned axis = 0; axis < model.axes; axis++) {
        config.sigma[axis] = more == 255U ? any_float(in) : 0.01F * moderate(in);
        config.is_rate[axis] = (how & 128U) != 0U;
    }
    const selfcal_status_t status = selfcal_gate_init(&gate, &config);
    HOLDS(status == SELFCAL_OK || status == SELFCAL_BAD_ARGUMENT);
    has_gate = status == SELFCAL_OK;
}

static void look_at_gate(input_t *in) {
    if (!has_gate) {
        return;
    }
    const uint8_t axis = byte(in) % (SELFCAL_AXES_MAX + 1U), how = byte(in);
    selfcal_gate_noise_t noise;
    selfcal_status_t status = selfcal_gate_measured(&gate, axis, &noise);
    HOLDS(status == SELFCAL_OK || status == SELFCAL_TOO_SHORT || status == SELFCAL_BAD_ARGUMENT);
    if (status != SELFCAL_OK) {
        noise.sigma = how == 255U ? any_float(in) : 0.01F * moderate(in);
        noise.within = how == 255U ? any_float(in) : moderate(in);
        noise.spread = how == 255U ? any_float(in) : moderate(in);
        noise.level = how == 255U ? any_float(in) : moderate(in);
    }
    status = selfcal_gate_noise(&gate, axis, &noise);
    HOLDS(status == SELFCAL_OK || status == SELFCAL_BAD_ARGUMENT);
    HOLDS(axis < model.axes || status == SELFCAL_BAD_ARGUMENT);
}

static void send_status(input_t *in) {
    static const char *const names[][SELFCAL_AXES_MAX] = {
        {"gx", "gy", "gz"}, {"ax", "ay", "az"}, {"gx", "gx", "gx"}, {"", "az", "xyz"}};
    const uint8_t which = byte(in);
    const selfcal_status_t status = selfcal_telemetry_init(&telemetry, &model, names[which & 3U]);
    HOLDS(status == SELFCAL_OK || status == SELFCAL_BAD_MODEL);
    has_telemetry = status == SELFCAL_OK;
    if (has_telemetry) {
        const uint8_t node = which >> 3;
        HOLDS(selfcal_telemetry_node(&telemetry, node) == (node < 12U ? SELFCAL_OK : SELFCAL_BAD_ARGUMENT));
        HOLDS(selfcal_telemetry_status(&telemetry, selfcal_counters(&bank.self),
                                       (which & 4U) != 0U ? SELFCAL_RUNNING : SELFCAL_FINISHED, which,
                                       (uint32_t)bits(in, 4)) == SELFCAL_OK);
        check_frames();
    }
}

static void twin_from_snapshot(void) {
    static store_t store;
    if (tampered || snapshots == 0U) {
        return;
    }
    snapshots--;
    HOLDS(save(&bank, &store) == SELFCAL_OK);
    memset(&twin.self, 0xA5, sizeof twin.self);
    memset(twin.memory, 0xA5, in_use);
    HOLDS(restore(&twin, &store) == SELFCAL_OK);
    twinned = true;
    reporting = false; /* the twin has none */
    equal_banks(&bank, &twin);
}

static void mend_crc(store_t *store) {
    uint32_t crc = 0xFFFFFFFFU;
    for (size_t i = 0; i + 4U < store->length; i++) {
        crc = (crc >> 8) ^ crc_table[(crc ^ store->bytes[i]) & 255U];
    }
    for (unsigned i = 0; i < 4U; i++) {
        store->bytes[store->length - 4U + i] = (uint8_t)(~crc >> (8U * i));
    }
}

/* A snapshot with some bytes changed, cut or lengthened, its checksum mended or not. */
static void restore_mutated(input_t *in) {
    static store_t store, mutated;
    static bank_t kept;
    if (snapshots == 0U) {
        return;
    }
    snapshots--;
    check_state();
    if (save(&bank, &store) != SELFCAL_OK) {
        HOLDS(tampered);
        return;
    }
    memcpy(mutated.bytes, store.bytes, store.length);
    mutated.length = store.length;
    const uint8_t how = byte(in);
    for (unsigned i = 0; i <= (how & 7U); i++) {
        mutated.bytes[bits(in, 2) % store.length] ^= byte(in);
    }
    if ((how & 0x30U) == 0x30U) {
        mutated.length = bits(in, 2) % sizeof mutated.bytes;
    }
    if (mutated.length > store.length) {
        memset(mutated.bytes + store.length, 0, mutated.length - store.length);
    }
    if ((how & 0x40U) != 0U && mutated.length > 4U) {
        mend_crc(&mutated);
    }
    const bool same = mutated.length == store.length && memcmp(mutated.bytes, store.bytes, store.length) == 0;
    moved = true;
    kept.self = bank.self;
    memcpy(kept.memory, bank.memory, in_use);
    const selfcal_status_t status = restore(&bank, &mutated);
    reporting = false;
    if (same) {
        HOLDS(status == SELFCAL_OK && memcmp(kept.memory, bank.memory, in_use) == 0);
    } else if (status == SELFCAL_OK) {
        HOLDS((how & 0x40U) != 0U); /* no flip gets past the checksum */
        HOLDS(selfcal_check(&bank.self) == SELFCAL_OK);
        tampered = true;
        twinned = false;
    } else if (status == SELFCAL_CORRUPT) {
        HOLDS((how & 0x40U) != 0U);
        HOLDS(selfcal_count(&bank.self) == 0U);
        tampered = false;
        twinned = false;
        memset(&before, 0, sizeof before);
        count_before = 0;
    } else {
        HOLDS(status <= SELFCAL_SNAPSHOT_TRUNCATED && status >= SELFCAL_SNAPSHOT_VERSION);
        HOLDS(memcmp(&kept.self, &bank.self, sizeof bank.self) == 0 && memcmp(kept.memory, bank.memory, in_use) == 0);
    }
}

static void failing_save(input_t *in) {
    static store_t store;
    if (snapshots == 0U) {
        return;
    }
    snapshots--;
    const size_t size = selfcal_snapshot_size(&bank.self);
    store.length = 0;
    store.fail_at = 1U + bits(in, 2) % size;
    const selfcal_status_t status = selfcal_save(&bank.self, append, &store);
    HOLDS(status == SELFCAL_WRITE_FAILED || (tampered && status == SELFCAL_CORRUPT));
}

static void bad_arguments(input_t *in) {
    const float sample[SELFCAL_AXES_MAX] = {0};
    HOLDS(selfcal_push(NULL, sample) == SELFCAL_BAD_ARGUMENT && selfcal_push(&bank.self, NULL) == SELFCAL_BAD_ARGUMENT);
    HOLDS(selfcal_skip(NULL, byte(in)) == SELFCAL_BAD_ARGUMENT && selfcal_check(NULL) == SELFCAL_BAD_ARGUMENT);
    HOLDS(selfcal_save(NULL, append, NULL) == SELFCAL_BAD_ARGUMENT &&
          selfcal_save(&bank.self, NULL, NULL) == SELFCAL_BAD_ARGUMENT);
    HOLDS(selfcal_report_begin(NULL, &bank.self, 0, &report) == SELFCAL_BAD_ARGUMENT);
    HOLDS(selfcal_restore(&twin.self, &model, twin.memory, in_use, NULL, 100) == SELFCAL_BAD_ARGUMENT);
    HOLDS(selfcal_init(&twin.self, &model, twin.memory, in_use - 1U) == SELFCAL_BAD_MEMORY);
}

int LLVMFuzzerInitialize(int *argc, char ***argv);
int LLVMFuzzerInitialize(int *argc, char ***argv) {
    (void)argc;
    (void)argv;
    make_fit();
    for (uint32_t i = 0; i < 256U; i++) {
        crc_table[i] = i;
        for (int bit = 0; bit < 8; bit++) {
            crc_table[i] = (crc_table[i] >> 1) ^ ((crc_table[i] & 1U) != 0U ? 0xEDB88320U : 0U);
        }
    }
    return 0;
}

/* FNV-1a: lets one execution in some do what would slow down all. */
static uint32_t hash(const uint8_t *data, size_t size) {
    uint32_t value = 2166136261U;
    for (size_t i = 0; i < size; i++) {
        value = (value ^ data[i]) * 16777619U;
    }
    return value >> 16;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    input_t in = {data, data + size};
    const uint32_t chance = hash(data, size);
    const bool longer = chance % 8U == 0U;
    make_model(&in, longer);
    in_use = sizeof bank.memory;
    fence(&bank);
    const selfcal_status_t status = selfcal_init(&bank.self, &model, bank.memory, sizeof bank.memory);
    if (status != SELFCAL_OK) {
        HOLDS(status == SELFCAL_BAD_MODEL || status == SELFCAL_BAD_MEMORY);
        return 0;
    }
    in_use = needed();
    fence(&bank);
    fence(&twin);
    twinned = tampered = reporting = has_telemetry = has_gate = false;
    pushes = longer ? 200U : 64U;
    sample_effort = effort_of_sample();
    effort = (longer ? 4U : 1U) * (SAMPLES_MIN * sample_effort < EFFORT ? EFFORT : SAMPLES_MIN * sample_effort);
    snapshots = chance / 8U % (1U + model.nodes / 6U) == 0U ? 2U : 0U;
    flushes = (longer ? 4U : 1U) * (2U + EFFORT / 4U / sample_effort);
    reports = 3;
    moved = false;
    const bool whole = chance / 32U % 32U == 0U;
    steps = whole ? STEPS_MAX : 8U;
    memset(&before, 0, sizeof before);
    count_before = 0;
    for (unsigned call = 0; call < CALLS_MAX && in.at < in.end; call++) {
        switch (byte(&in) & 31U) {
        case 0: push_any(&in); break;
        case 1: push_many(&in); break;
        case 2: skip(byte(&in)); break;
        case 3: skip((uint64_t)1 << (byte(&in) & 63U)); break;
        case 4: skip(bits(&in, 8)); break;
        case 5: look_at_node(&in); break;
        case 6: report_begin(&in); break;
        case 7: report_steps(byte(&in)); break;
        case 8: report_steps(STEPS_MAX); break;
        case 9: send_status(&in); break;
        case 10: twin_from_snapshot(); break;
        case 11: restore_mutated(&in); break;
        case 12: failing_save(&in); break;
        case 13: bad_arguments(&in); break;
        case 14: moving(); break;
        case 15: rate(&in); break;
        case 16: begin_gate(&in); break;
        case 17: look_at_gate(&in); break;
        case 18: set_values(&in); break;
        case 19: shift(&in); break;
        case 20: push_in_motion(&in); break;
        default: push_moderate(&in); break;
        }
        check_counters();
        if (call % LOOK_EVERY == LOOK_EVERY - 1U) {
            check_state();
        }
    }
    check_state();
    HOLDS(steps > 0U || !reporting || !whole); /* no report is endless */
    if (twinned) {
        equal_banks(&bank, &twin);
    }
    return 0;
}
