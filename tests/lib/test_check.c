/* selfcal_check(): content with whatever pushes, skips and reports make of a bank, and with nothing else. */
#include <math.h>
#include <string.h>

#include "selfcal_model.h"
#include "unity.h"

#define AXES SELFCAL_MODEL_AXES
#define BYTES SELFCAL_SIZE(SELFCAL_MODEL_NODES, AXES)
enum { BLOCK = 4 };

static selfcal_t bank, sound;
static selfcal_model_t model;
static selfcal_work_t work;
static selfcal_report_t report;
/* selfcal_init() must be content with these bytes, and leave the ones behind alone. */
static union {
    selfcal_wide_t align;
    uint8_t bytes[BYTES + 16U];
} memory, sound_memory;

/* the compiler has evaluated it */
static const uint8_t compile_time[SELFCAL_SIZE(3, 2)];

/* A uniform number in [-1, 1). */
static uint32_t state;
static float noise(void) {
    state ^= state << 13;
    state ^= state >> 17;
    state ^= state << 5;
    return (float)state / 2147483648.0F - 1.0F;
}

static void push(void) {
    float sample[AXES];
    for (unsigned axis = 0; axis < AXES; axis++) {
        sample[axis] = 0.1F + 0.02F * noise();
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, sample));
}

void setUp(void) {
    model = selfcal_model;
    model.block = BLOCK;
    model.dt_s = 1.0F;
    state = 12345U;
    memset(&memory, 0xA5, sizeof memory);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&bank, &model, memory.bytes, BYTES));
}

void tearDown(void) {}

static void the_size_is_what_init_demands(void) {
    TEST_ASSERT_EQUAL(sizeof compile_time, 3U * SELFCAL_SIZE(1, 2));
    for (int i = 0; i < 1000; i++) {
        push();
    }
    for (size_t i = BYTES; i < sizeof memory.bytes; i++) {
        TEST_ASSERT_EQUAL_HEX8(0xA5, memory.bytes[i]);
    }
    TEST_ASSERT_TRUE((const uint8_t *)(bank.x + (size_t)model.nodes * AXES) == memory.bytes + BYTES);
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MEMORY, selfcal_init(&bank, &model, memory.bytes, BYTES - 1U));
}

static void a_bank_at_work_is_sound(void) {
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_check(NULL));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_check(&bank));
    for (int i = 0; i < 1500; i++) {
        if (i % 7 == 3) {
            const float bad[AXES] = {NAN};
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, bad));
        } else {
            push();
        }
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_check(&bank));
        if (i % 131 == 77) {
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&bank, (uint64_t)1 << (i / 50)));
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_check(&bank));
        }
        if (i == 700) {
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, 0, &report));
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_check(&bank));
        }
    }
}

/* Readings that never change, or sit at 0: sums of zero are sound. */
static void a_silent_sensor_is_sound(void) {
    for (int i = 0; i < 300; i++) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, (const float[AXES]){0.0F, 1.0F}));
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_check(&bank));
    }
}

/* As much white noise and as little walk as a model may have: variances of drift over white noise are denormals, or
 * 0. */
static void a_model_at_its_limits_is_sound(void) {
    selfcal_axis_t axes[AXES];
    memcpy(axes, selfcal_model.axis, sizeof axes);
    for (unsigned axis = 0; axis < AXES; axis++) {
        axes[axis].prior[SELFCAL_N] = (selfcal_prior_t){41.0F, 46.0F, SELFCAL_LOG_UNIFORM, false};
        axes[axis].range = 0.0F;
    }
    model.axis = axes;
    model.dt_s = 1e-6F;
    for (float ln_k = -46.0F; ln_k <= -26.0F; ln_k += 0.5F) {
        for (unsigned axis = 0; axis < AXES; axis++) {
            axes[axis].prior[SELFCAL_K] = (selfcal_prior_t){ln_k, ln_k + 5.0F, SELFCAL_LOG_UNIFORM, false};
        }
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&bank, &model, memory.bytes, BYTES));
        for (int i = 0; i < 60 * BLOCK; i++) {
            float sample[AXES];
            for (unsigned axis = 0; axis < AXES; axis++) {
                sample[axis] = 1.5e11F * noise();
            }
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, sample));
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_check(&bank));
        }
    }
}

static void mend(void) {
    bank = sound;
    memory = sound_memory;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_check(&bank));
}

/* Breaks one thing, looks, mends it. */
#define BROKEN(statement)                                                                                              \
    do {                                                                                                               \
        statement;                                                                                                     \
        TEST_ASSERT_EQUAL(SELFCAL_CORRUPT, selfcal_check(&bank));                                                      \
        mend();                                                                                                        \
    } while (0)

static void each_broken_invariant_is_seen(void) {
    for (int i = 0; i < 1000 || bank.batch[bank.gathering].count < 3U || bank.used == 0U || bank.ran == 0U; i++) {
        push();
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&bank, 1));
    sound = bank;
    sound_memory = memory;
    mend();
    const size_t last = (size_t)model.nodes * AXES - 1U;
    selfcal_node_t *const node = bank.node;
    selfcal_batch_t *const gathered = &bank.batch[bank.gathering], *const waits = &bank.batch[1U - bank.gathering];
    uint16_t level = 0;
    while (!node[level].level) {
        level++;
    }
    /* places and pointers */
    BROKEN(bank.model = NULL);
    BROKEN(bank.node = NULL);
    BROKEN(bank.b++);
    BROKEN(bank.c--);
    BROKEN(bank.x++);
    BROKEN(gathered->count = SELFCAL_BATCH);
    BROKEN(waits->count = SELFCAL_BATCH + 1U);
    BROKEN(bank.gathering = 2);
    BROKEN(bank.ran = model.nodes);
    BROKEN(waits->count = 0); /* nothing to run over, yet half of the nodes have */
    BROKEN(bank.push_nodes = 0);
    BROKEN(bank.keep = 0.5); /* this model forgets nothing */
    BROKEN(bank.beginning = 0.5);
    BROKEN(gathered->gap_after = 1);
    BROKEN(bank.position = BLOCK);
    BROKEN(bank.used = bank.position + 1U);
    /* the batch */
    BROKEN(waits->y[AXES - 1U][0] = NAN);
    BROKEN(gathered->y[0][gathered->count - 1U] = INFINITY);
    BROKEN(gathered->r[0] = 0.99F / SELFCAL_VARIANCE_RATIO_MAX);
    BROKEN(waits->r[0] = 2.01F * SELFCAL_VARIANCE_RATIO_MAX);
    BROKEN(gathered->r[0] = NAN);
    BROKEN(waits->r[0] = 1.5F); /* which `part` would have to tell */
    /* the averager */
    BROKEN(bank.started = false);
    BROKEN(bank.origin[0] = NAN);
    BROKEN(bank.offset[AXES - 1U] = INFINITY);
    BROKEN(bank.last[0] = NAN);
    BROKEN(bank.variance_ratio = 0.0F);
    BROKEN(bank.dropped = true);
    BROKEN(bank.retired = (1U << AXES) - 1U);
    BROKEN(bank.bad[0] = bank.watched + 1U);
#ifdef SELFCAL_FIXED
    BROKEN(bank.sums[0].first = INT32_MIN);
    BROKEN(bank.sums[0].sum = INT64_MIN);
    BROKEN(bank.sums[0].sum_sq = -1);
    BROKEN(bank.sums[0].exponent = 101);
    BROKEN(bank.sums[0].shift = 16);
#else
    BROKEN(bank.sums[0].first = NAN);
    BROKEN(bank.sums[0].sum = NAN);
    BROKEN(bank.sums[0].sum_sq = -1.0F);
#endif
    BROKEN(bank.within[AXES - 1U] = -1.0);
    BROKEN(bank.within[0] = INFINITY);
    /* bytes that are no bool */
    BROKEN(memset(&bank.started, 2, 1));
    BROKEN(memset(&bank.dropped, 0x80, 1));
    BROKEN(memset(&bank.in_gap, 255, 1));
    BROKEN(memset(&gathered->part, 2, 1));
    BROKEN(memset(&waits->part, 254, 1));
    BROKEN(memset(&node[level].level, 3, 1));
    /* counts that do not fit */
    BROKEN(bank.counters.samples = 0);
    BROKEN(bank.counters.samples = bank.within_dof);
    BROKEN(bank.counters.samples = selfcal_count(&bank));
    BROKEN(bank.counters.blocks_part = selfcal_count(&bank) + 1U);
    BROKEN(bank.counters.gaps = 0);
    BROKEN(node[0].steady = bank.n + waits->count + 1U);
    /* the grid */
    BROKEN(bank.rho_step[1] = 0.0F);
    BROKEN(bank.rho_lo[1] = NAN);
    BROKEN(bank.alpha_step[2] = -1.0F);
    BROKEN(bank.alpha_lo[2] = INFINITY);
    /* nodes, the last and others */
    BROKEN(node[model.nodes - 1U].beta = 1.1F);
    BROKEN(node[1].beta = -1e-3F);
    BROKEN(node[1].beta = 1.0F); /* gains over 1 - beta */
    BROKEN(node[1].q = -1e-9F);
    BROKEN(node[1].q = INFINITY);
    BROKEN(node[1].p_inf = NAN);
    BROKEN(node[1].p_inf = -1.0F);
    BROKEN(node[1].gains.moving.c = 1.5F);
    BROKEN(node[1].gains.moving.d = -1.1F * node[1].p_inf);
    BROKEN(node[1].gains.moving.d = NAN);
    BROKEN(node[1].gains.moving.d = 1e23F); /* no gap is so long */
    BROKEN(node[1].u_inf = 1.5F);
    BROKEN(node[1].gains.moving.e = 1.5F);
    BROKEN(node[level].gains.moving.d = 1e-9F);
    BROKEN(node[level].gains.moving.e = 1e-9F);
    BROKEN(node[level].level_from = node[level].steady + 1U);
    BROKEN(node[level].level = false);
    BROKEN(node[1].a.hi = -1.0F);
    BROKEN(node[1].a.lo = NAN);
    BROKEN(node[1].ln_s.hi = INFINITY);
#ifdef SELFCAL_FIXED
    BROKEN(bank.b[0] = INT64_MAX);
    BROKEN(bank.b[last] = INT64_MIN);
    BROKEN(bank.c[last] = -1);
    BROKEN(bank.c[0] = INT64_MAX);
    BROKEN(bank.x[last] = INT32_MAX);
    BROKEN(bank.x[0] = INT32_MIN);
    BROKEN(bank.x[0] = 2 * SELFCAL_FIXED_LIMIT); /* among the readings, but for rounding */
    BROKEN(bank.integers.scale[AXES - 1U].exponent = 201);
    BROKEN(bank.integers.scale[0].most_y = -1);
    BROKEN(bank.integers.y[0][SELFCAL_BATCH - 1U] = INT32_MAX);
    BROKEN(bank.integers.step[AXES - 1U][SELFCAL_BATCH] = INT32_MIN);
    BROKEN(bank.integers.step[0][1]++); /* not that of its readings */
    BROKEN(bank.integers.step_from = bank.integers.step_to + 1U);
    BROKEN(bank.integers.step_to = SELFCAL_BATCH + 1U);
    BROKEN(bank.integers.step_beta = NAN);
    BROKEN(node[level].g_shift++);
    BROKEN(node[level].u_shift = 64);
    BROKEN(node[level].gains.settled.w++);
#else
    BROKEN(bank.b[0].hi = NAN);
    BROKEN(bank.b[last].lo = INFINITY);
    BROKEN(bank.c[last].hi = -1.0F);
    BROKEN(bank.c[0].hi = NAN);
    BROKEN(bank.x[last] = NAN);
#endif
    /* before the first sample */
    setUp();
    sound = bank;
    sound_memory = memory;
    BROKEN(bank.pending_gap = 1);
    BROKEN(bank.position = 1);
    BROKEN(bank.in_gap = true);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(the_size_is_what_init_demands);
    RUN_TEST(a_bank_at_work_is_sound);
    RUN_TEST(a_silent_sensor_is_sound);
    RUN_TEST(a_model_at_its_limits_is_sound);
    RUN_TEST(each_broken_invariant_is_seen);
    return UNITY_END();
}
