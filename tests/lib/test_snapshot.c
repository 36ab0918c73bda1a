/* Snapshots: what is restored goes on bit for bit like what was never stopped; anything else is refused. */
#include <math.h>
#include <string.h>

#include "selfcal_model.h"
#include "unity.h"

/* A drift, and the bits of what is none. */
#ifdef SELFCAL_FIXED
#define SOME_X 77
#define NO_X 0x7FFFFFFFU
#define REAL_BYTES 32
#else
#define SOME_X 7.7e-5F
#define NO_X 0x7FC00000U /* a quiet NaN */
#define REAL_BYTES sizeof(selfcal_real_t)
#endif

enum { AXES = 2, BLOCK = 3, SAMPLES = 420 };
#define MEMORY_BYTES SELFCAL_SIZE(SELFCAL_MODEL_NODES, SELFCAL_MODEL_AXES)
#define BYTES_MAX SELFCAL_SNAPSHOT_MAX(SELFCAL_MODEL_BYTES)
enum {
    OFFSET_LENGTH = 4,
    OFFSET_VERSION = 8,
    OFFSET_REAL = 10,
    OFFSET_AXES = 11,
    OFFSET_NODES = 12,
    OFFSET_ID = 16,
    OFFSET_N = 24
};

typedef struct {
    selfcal_t self;
    selfcal_wide_t memory[MEMORY_BYTES / sizeof(selfcal_wide_t) + 1U];
} bank_t;

typedef struct {
    uint8_t bytes[BYTES_MAX];
    size_t length;
    unsigned calls, fail_at; /* fail_at: the call that fails, from 1; 0: none */
} store_t;

static bank_t bank, other, before;
static store_t saved, again;
static selfcal_model_t model;
static selfcal_axis_t axis_table[AXES];
static selfcal_work_t work;

static selfcal_batch_t *gathered(bank_t *from) {
    return &from->self.batch[from->self.gathering];
}

/* The state of the noise after `index` draws is a function of the index: a record that can be entered anywhere. */
static float noise(uint32_t index) {
    float sum = 0.0F; /* of 12 uniforms: variance 1 */
    for (uint32_t i = 0; i < 12U; i++) {
        uint32_t state = (index * 12U + i + 1U) * 2654435769U;
        state = (state ^ (state >> 16)) * 2246822519U;
        state = (state ^ (state >> 13)) * 3266489917U;
        sum += (float)(state ^ (state >> 16)) / 4294967296.0F;
    }
    return sum - 6.0F;
}

/* Step `i` of a record with everything in it that counts: gaps in blocks and over them, bad samples of each kind,
 * reports. */
static void step(selfcal_t *self, uint32_t i) {
    float sample[AXES];
    for (uint32_t axis = 0; axis < AXES; axis++) {
        sample[axis] = 0.25F + 0.02F * noise(i * AXES + axis);
    }
    if (i % 97U == 13U || (i >= 246U && i < 265U)) {
        sample[0] = NAN; /* the second time for whole blocks */
    } else if (i % 89U == 21U) {
        sample[1] = axis_table[1].range;
    } else if (i % 61U < 5U) {
        sample[1] = 0.25F; /* stuck from the third on */
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(self, sample));
    if (i % 29U == 7U) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(self, 1));
    } else if (i % 101U == 50U) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(self, 40));
    } else if (i % 67U == 31U) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_moving(self));
    } else if (i == 130U) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_rate(self, BLOCK + 1U, 1.5F));
    } else if (i == 200U) {
        selfcal_report_t report;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, self, 1, &report));
    }
}

static bool append(void *context, const void *bytes, size_t count) {
    store_t *store = context;
    store->calls++;
    if (store->calls == store->fail_at) {
        return false;
    }
    TEST_ASSERT_TRUE(count == SELFCAL_SNAPSHOT_CHUNK || (count > 0U && count < SELFCAL_SNAPSHOT_CHUNK));
    TEST_ASSERT_TRUE(store->length % SELFCAL_SNAPSHOT_CHUNK == 0U); /* only the last one is short */
    TEST_ASSERT_TRUE(store->length + count <= sizeof store->bytes);
    memcpy(store->bytes + store->length, bytes, count);
    store->length += count;
    return true;
}

static selfcal_status_t save(const bank_t *from, store_t *store) {
    memset(store, 0, sizeof *store);
    return selfcal_save(&from->self, append, store);
}

static selfcal_status_t restore(bank_t *to, const store_t *store) {
    return selfcal_restore(&to->self, &model, to->memory, sizeof to->memory, store->bytes, store->length);
}

/* CRC-32 by its definition, bit by bit (IEEE 802.3, 3.2.9, in reflected form). */
static uint32_t crc32_by_definition(const uint8_t *bytes, size_t count) {
    static uint32_t of_byte[256]; /* of each, once */
    for (uint32_t byte = 0; of_byte[255] == 0U && byte < 256U; byte++) {
        of_byte[byte] = byte;
        for (int bit = 0; bit < 8; bit++) {
            of_byte[byte] = (of_byte[byte] >> 1) ^ ((of_byte[byte] & 1U) != 0U ? 0xEDB88320U : 0U);
        }
    }
    uint32_t crc = 0xFFFFFFFFU;
    for (size_t i = 0; i < count; i++) {
        crc = crc >> 8 ^ of_byte[(crc ^ bytes[i]) & 0xFFU];
    }
    return ~crc;
}

static uint32_t number_at(const store_t *store, size_t at, size_t size) {
    uint32_t number = 0;
    for (size_t i = 0; i < size; i++) {
        number |= (uint32_t)store->bytes[at + i] << (8U * i);
    }
    return number;
}

static void mend_crc(store_t *store) {
    const uint32_t crc = crc32_by_definition(store->bytes, store->length - 4U);
    for (unsigned i = 0; i < 4U; i++) {
        store->bytes[store->length - 4U + i] = (uint8_t)(crc >> (8U * i));
    }
}

/* A model of 1 + rho nodes and one axis: snapshots small enough to try every bit of. */
static void make_small(void) {
    model.hypotheses = 2;
    model.axes = 1;
    model.nodes = (uint16_t)(1U + model.hypothesis[1].rho->nodes);
    TEST_ASSERT_EQUAL(0, model.hypothesis[0].law->terms);
    TEST_ASSERT_EQUAL(SELFCAL_WALK, model.hypothesis[1].law->term[0].kind);
}

static void begin(bank_t *to) {
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&to->self, &model, to->memory, sizeof to->memory));
}

static void run(bank_t *to, uint32_t from, uint32_t until) {
    for (uint32_t i = from; i < until; i++) {
        step(&to->self, i);
    }
}

void setUp(void) {
    model = selfcal_model;
    model.block = BLOCK;
    model.dt_s = 1.0F;
    model.axes = AXES;
    for (unsigned axis = 0; axis < AXES; axis++) {
        axis_table[axis] = selfcal_model.axis[axis];
        axis_table[axis].stuck_limit = 3;
    }
    model.axis = axis_table;
}

void tearDown(void) {}

/* Equal snapshots at the end are equal states: every field of the bank is in them (the next test). */
static void restored_anywhere_and_continued_equals_uninterrupted(void) {
    static uint8_t cut[SAMPLES][BYTES_MAX];
    unsigned in_batch = 0, running = 0, in_block = 0, in_gap = 0;
    begin(&bank);
    size_t length = 0;
    for (uint32_t i = 0; i < SAMPLES; i++) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, save(&bank, &saved));
        TEST_ASSERT_EQUAL(selfcal_snapshot_size(&bank.self), saved.length);
        TEST_ASSERT_TRUE(length == 0U || length == saved.length);
        length = saved.length;
        memcpy(cut[i], saved.bytes, length);
        in_batch += gathered(&bank)->count > 0U ? 1U : 0U;
        running += bank.self.ran > 0U ? 1U : 0U;
        in_block += bank.self.position > 0U ? 1U : 0U;
        in_gap += bank.self.pending_gap > 0U ? 1U : 0U;
        step(&bank.self, i);
    }
    /* else the cuts are not where they should be */
    TEST_ASSERT_TRUE(in_batch > 300U && running > 50U && in_block > 200U && in_gap > 5U);
    TEST_ASSERT_EQUAL(SELFCAL_OK, save(&bank, &saved));
    for (uint32_t i = 0; i < SAMPLES; i++) {
        memset(&other, 0xA5, sizeof other); /* what was there before must not matter */
        TEST_ASSERT_EQUAL(SELFCAL_OK,
                          selfcal_restore(&other.self, &model, other.memory, sizeof other.memory, cut[i], length));
        run(&other, i, SAMPLES);
        TEST_ASSERT_EQUAL(SELFCAL_OK, save(&other, &again));
        TEST_ASSERT_EQUAL_MEMORY(saved.bytes, again.bytes, length);
    }
    selfcal_report_t one, two;
    memset(&one, 0, sizeof one);
    memset(&two, 0, sizeof two);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank.self, 0, &one));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &other.self, 0, &two));
    TEST_ASSERT_EQUAL_MEMORY(&one, &two, sizeof one);
}

/* Everything but the pointers, padding and all (selfcal_init() clears it): a member that a snapshot leaves out differs,
 * unless it is 0. So none may be: the counters are looked at, the rest is what the record makes of it. */
static void every_byte_of_the_bank_comes_back(void) {
    begin(&bank);
    run(&bank, 0, 250);
    for (uint32_t i = 250; i < 265U && (bank.self.watched == 0U || bank.self.bad_blocks[0] == 0U); i++) {
        step(&bank.self, i);
    }
    const selfcal_counters_t *count = selfcal_counters(&bank.self);
    TEST_ASSERT_TRUE(count->samples > 0U && count->missing > 0U && count->gaps > 0U && count->blocks_lost > 0U &&
                     count->blocks_part > 0U && count->blocks_moving > 0U && count->not_finite[0] > 0U &&
                     count->saturated[1] > 0U && count->stuck[1] > 0U);
    TEST_ASSERT_TRUE(bank.self.watched > 0U && bank.self.bad[0] > 0U && bank.self.bad_blocks[0] > 0U);
    TEST_ASSERT_EQUAL(SELFCAL_OK, save(&bank, &saved));
    memset(&other, 0xA5, sizeof other);
    TEST_ASSERT_EQUAL(SELFCAL_OK, restore(&other, &saved));
    const size_t from = offsetof(selfcal_t, n);
    TEST_ASSERT_EQUAL_MEMORY((const uint8_t *)&bank.self + from, (const uint8_t *)&other.self + from,
                             sizeof(selfcal_t) - from);
    TEST_ASSERT_EQUAL_MEMORY(bank.memory, other.memory, SELFCAL_SIZE(model.nodes, model.axes));
    TEST_ASSERT_EQUAL_PTR(&model, other.self.model);
    TEST_ASSERT_EQUAL_PTR(other.memory, other.self.b);
}

static void saving_changes_nothing(void) {
    begin(&bank);
    run(&bank, 0, 100);
    before = bank;
    TEST_ASSERT_EQUAL(SELFCAL_OK, save(&bank, &saved));
    TEST_ASSERT_EQUAL_MEMORY(&before, &bank, sizeof bank);
}

/* The format as snapshot.c describes it, read here byte by byte. */
static void the_format_is_the_one_described(void) {
    model.id = 0x89ABCDEFU;
    begin(&bank);
    run(&bank, 0, 3U * BLOCK * SELFCAL_BATCH);
    selfcal_node_view_t view;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank.self, 0, 0, &view)); /* folds the batch */
    TEST_ASSERT_EQUAL(SELFCAL_OK, save(&bank, &saved));
    TEST_ASSERT_EQUAL_MEMORY("SFCL", saved.bytes, 4);
    TEST_ASSERT_EQUAL(saved.length, number_at(&saved, OFFSET_LENGTH, 4));
    TEST_ASSERT_EQUAL(3, number_at(&saved, OFFSET_VERSION, 2));
    TEST_ASSERT_EQUAL(REAL_BYTES, number_at(&saved, OFFSET_REAL, 1));
    TEST_ASSERT_EQUAL(AXES, number_at(&saved, OFFSET_AXES, 1));
    TEST_ASSERT_EQUAL(model.nodes, number_at(&saved, OFFSET_NODES, 2));
    TEST_ASSERT_EQUAL(0, number_at(&saved, 14, 2));
    TEST_ASSERT_EQUAL_HEX32(0x89ABCDEFU, number_at(&saved, OFFSET_ID, 4));
    TEST_ASSERT_EQUAL(selfcal_count(&bank.self), number_at(&saved, OFFSET_N, 4));
    TEST_ASSERT_EQUAL_HEX32(crc32_by_definition(saved.bytes, saved.length - 4U),
                            number_at(&saved, saved.length - 4U, 4));
    /* the usual check value */
    TEST_ASSERT_EQUAL_HEX32(0xCBF43926U, crc32_by_definition((const uint8_t *)"123456789", 9));
    TEST_ASSERT_TRUE(saved.length <= SELFCAL_SNAPSHOT_MAX(SELFCAL_SIZE(model.nodes, model.axes)));
#ifndef SELFCAL_FIXED
    /* the last real before the checksum is x of the last node and axis: four bytes of an IEEE single, lowest first */
    const uint32_t bits = number_at(&saved, saved.length - 8U, 4);
    float x;
    memcpy(&x, &bits, sizeof x);
    TEST_ASSERT_TRUE(x == bank.self.x[(size_t)model.nodes * AXES - 1U] && x != 0.0F);
#endif
}

static void any_alignment_will_do(void) {
    make_small();
    begin(&bank);
    run(&bank, 0, 50);
    TEST_ASSERT_EQUAL(SELFCAL_OK, save(&bank, &saved));
    for (size_t shift = 0; shift < 8U; shift++) {
        memmove(again.bytes + shift, saved.bytes, saved.length);
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_restore(&other.self, &model, other.memory, sizeof other.memory,
                                                      again.bytes + shift, saved.length));
        TEST_ASSERT_EQUAL_MEMORY(bank.memory, other.memory, SELFCAL_SIZE(model.nodes, model.axes));
    }
}

/* --- refusals --- */

/* `other` holds a bank at work, which a refusal leaves alone. */
static void refused(selfcal_status_t expected, const store_t *store) {
    before = other;
    const selfcal_status_t status = restore(&other, store);
    TEST_ASSERT_EQUAL(expected, status);
    TEST_ASSERT_EQUAL_MEMORY(&before, &other, sizeof other);
}

static void begin_small_pair(void) {
    make_small();
    begin(&bank);
    run(&bank, 0, 150);
    begin(&other);
    run(&other, 20, 77);
    TEST_ASSERT_EQUAL(SELFCAL_OK, save(&bank, &saved));
}

static void every_single_bit_flip_is_refused(void) {
    begin_small_pair();
    before = other;
    for (size_t bit = 0; bit < 8U * saved.length; bit++) {
        saved.bytes[bit / 8U] ^= (uint8_t)(1U << bit % 8U);
        const selfcal_status_t status = restore(&other, &saved);
        TEST_ASSERT_TRUE(status <= SELFCAL_SNAPSHOT_TRUNCATED && status >= SELFCAL_SNAPSHOT_VERSION);
        TEST_ASSERT_TRUE(bit < 64U || status == SELFCAL_SNAPSHOT_DAMAGED); /* before: magic and length */
        saved.bytes[bit / 8U] ^= (uint8_t)(1U << bit % 8U);
    }
    TEST_ASSERT_EQUAL_MEMORY(&before, &other, sizeof other);
    TEST_ASSERT_EQUAL(SELFCAL_OK, restore(&other, &saved));
}

static void every_truncation_is_refused(void) {
    begin_small_pair();
    const size_t length = saved.length;
    for (saved.length = 0; saved.length < length; saved.length++) {
        refused(SELFCAL_SNAPSHOT_TRUNCATED, &saved);
    }
    saved.length = length + 1U;
    refused(SELFCAL_SNAPSHOT_TOO_LONG, &saved);
    saved.length = length;
    TEST_ASSERT_EQUAL(SELFCAL_OK, restore(&other, &saved));
}

static void erased_and_zeroed_memory_is_foreign(void) {
    begin_small_pair();
    memset(saved.bytes, 0xFF, saved.length);
    refused(SELFCAL_SNAPSHOT_FOREIGN, &saved);
    memset(saved.bytes, 0, saved.length);
    refused(SELFCAL_SNAPSHOT_FOREIGN, &saved);
}

/* The checksum is right, only the header says something else. */
static void other_models_builds_and_versions_are_refused(void) {
    static const struct {
        size_t at;
        selfcal_status_t expected;
    } trials[] = {
        {OFFSET_VERSION, SELFCAL_SNAPSHOT_VERSION},
        {OFFSET_VERSION + 1, SELFCAL_SNAPSHOT_VERSION},
        {OFFSET_REAL, SELFCAL_SNAPSHOT_FOREIGN},
        {OFFSET_AXES, SELFCAL_SNAPSHOT_FOREIGN},
        {OFFSET_NODES, SELFCAL_SNAPSHOT_FOREIGN},
        {OFFSET_NODES + 1, SELFCAL_SNAPSHOT_FOREIGN},
        {OFFSET_ID, SELFCAL_SNAPSHOT_FOREIGN},
        {OFFSET_ID + 3, SELFCAL_SNAPSHOT_FOREIGN},
        {14, SELFCAL_SNAPSHOT_FOREIGN},
        {20, SELFCAL_SNAPSHOT_FOREIGN}, /* reserved; layout */
    };
    begin_small_pair();
    for (size_t i = 0; i < sizeof trials / sizeof trials[0]; i++) {
        again = saved;
        again.bytes[trials[i].at]++;
        mend_crc(&again);
        refused(trials[i].expected, &again);
    }
    /* as a bank would see it: another id, an axis more */
    model.id++;
    refused(SELFCAL_SNAPSHOT_FOREIGN, &saved);
    model.id--;
    model.axes++;
    refused(SELFCAL_SNAPSHOT_FOREIGN, &saved);
    model.axes--;
    /* a length that header and checksum agree on, and the layout does not */
    again = saved;
    again.length += 4U;
    for (size_t i = 0; i < 4U; i++) {
        again.bytes[OFFSET_LENGTH + i] = (uint8_t)(again.length >> (8U * i));
    }
    TEST_ASSERT_TRUE(number_at(&again, OFFSET_LENGTH, 4) == again.length);
    mend_crc(&again);
    refused(SELFCAL_SNAPSHOT_FOREIGN, &again);
    TEST_ASSERT_EQUAL(SELFCAL_OK, restore(&other, &saved));
}

static void bad_arguments_change_nothing(void) {
    begin_small_pair();
    before = other;
    const size_t size = sizeof other.memory;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT,
                      selfcal_restore(NULL, &model, other.memory, size, saved.bytes, saved.length));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT,
                      selfcal_restore(&other.self, NULL, other.memory, size, saved.bytes, saved.length));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT,
                      selfcal_restore(&other.self, &model, NULL, size, saved.bytes, saved.length));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT,
                      selfcal_restore(&other.self, &model, other.memory, size, NULL, saved.length));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MEMORY,
                      selfcal_restore(&other.self, &model, other.memory, SELFCAL_SIZE(model.nodes, model.axes) - 1U,
                                      saved.bytes, saved.length));
    model.block = 0;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL,
                      selfcal_restore(&other.self, &model, other.memory, size, saved.bytes, saved.length));
    model.block = BLOCK;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_save(NULL, append, &again));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_save(&other.self, NULL, &again));
    TEST_ASSERT_EQUAL(0, selfcal_snapshot_size(NULL));
    TEST_ASSERT_EQUAL_MEMORY(&before, &other, sizeof other);
}

/* A medium that fails at any of its calls is not called again. */
static void a_write_that_fails_ends_the_save(void) {
    begin_small_pair();
    const unsigned calls = saved.calls;
    TEST_ASSERT_EQUAL((saved.length + SELFCAL_SNAPSHOT_CHUNK - 1U) / SELFCAL_SNAPSHOT_CHUNK, calls);
    for (unsigned fail_at = 1; fail_at <= calls; fail_at++) {
        memset(&again, 0, sizeof again);
        again.fail_at = fail_at;
        TEST_ASSERT_EQUAL(SELFCAL_WRITE_FAILED, selfcal_save(&bank.self, append, &again));
        TEST_ASSERT_EQUAL(fail_at, again.calls);
    }
}

/* The place of a field in a snapshot: where two banks differ that differ in it alone, both being sound. */
static size_t where_differ(const store_t *one, const store_t *two) {
    size_t at = OFFSET_N;
    while (one->bytes[at] == two->bytes[at]) {
        at++;
    }
    TEST_ASSERT_TRUE(at < one->length - 4U);
    return at;
}

/* The checksum fits, the contents cannot be: whoever made it, it must not get in. What is left is an empty bank that
 * works. */
static void corrupt(size_t at, size_t size, uint32_t value) {
    again = saved;
    for (size_t i = 0; i < size; i++) {
        again.bytes[at + i] = (uint8_t)(value >> (8U * i));
    }
    mend_crc(&again);
    TEST_ASSERT_EQUAL(SELFCAL_OK, restore(&other, &saved));
    TEST_ASSERT_EQUAL(SELFCAL_CORRUPT, restore(&other, &again));
    TEST_ASSERT_EQUAL(0, selfcal_count(&other.self));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_check(&other.self));
    begin(&before);
    run(&before, 0, 60);
    run(&other, 0, 60);
    const size_t from = offsetof(selfcal_t, n);
    TEST_ASSERT_EQUAL_MEMORY((const uint8_t *)&before.self + from, (const uint8_t *)&other.self + from,
                             sizeof(selfcal_t) - from);
    TEST_ASSERT_EQUAL_MEMORY(before.memory, other.memory, SELFCAL_SIZE(model.nodes, model.axes));
}

static void contents_that_no_bank_can_have_are_refused(void) {
    make_small();
    begin(&bank);
    for (uint32_t i = 0; i < 100U || gathered(&bank)->count < 2U || bank.self.used == 0U; i++) {
        step(&bank.self, i);
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, save(&bank, &saved));
    TEST_ASSERT_EQUAL(SELFCAL_OK, restore(&other, &saved)); /* its pointers lead into its own memory */

    gathered(&other)->count--;
    TEST_ASSERT_EQUAL(SELFCAL_OK, save(&other, &again));
    const size_t in_batch = where_differ(&saved, &again);
    gathered(&other)->count++;
    other.self.used--;
    TEST_ASSERT_EQUAL(SELFCAL_OK, save(&other, &again));
    const size_t used = where_differ(&saved, &again);
    other.self.used++;
    other.self.x[0] = SOME_X;
    TEST_ASSERT_EQUAL(SELFCAL_OK, save(&other, &again));
    const size_t x = where_differ(&saved, &again);
    other.self.x[0] = bank.self.x[0];
    other.self.in_gap = !other.self.in_gap;
    TEST_ASSERT_EQUAL(SELFCAL_OK, save(&other, &again));
    const size_t in_gap = where_differ(&saved, &again);
    TEST_ASSERT_EQUAL(gathered(&bank)->count, number_at(&saved, in_batch, 4));
    TEST_ASSERT_EQUAL(bank.self.used, number_at(&saved, used, 4));

    corrupt(in_batch, 4, SELFCAL_BATCH);
    corrupt(in_batch, 4, 0xFFFFFFFFU);
    corrupt(used, 4, BLOCK + 1U);
    corrupt(x, 4, NO_X);
    corrupt(in_gap, 1, 2);
    corrupt(in_gap, 1, 0xFF);
}

/* Anybody can make a checksum. What gets in may be wrong, but nothing that is undefined follows: the sanitizers
 * watch. */
static void hostile_contents_are_refused_or_harmless(void) {
    /* 1.0 and the greatest float, which is a great integer too */
    static const uint32_t extreme[] = {0x3F800000U, 0x7F7FFFFFU};
    begin_small_pair();
    const size_t end = saved.length - 4U;
    uint32_t refusals = 0U;
    for (size_t at = OFFSET_N; at + 4U <= end; at++) {
        for (unsigned k = 0; k < 2U; k++) {
            again = saved;
            for (unsigned i = 0; i < 4U; i++) {
                again.bytes[at + i] = (uint8_t)(extreme[k] >> (8U * i));
            }
            mend_crc(&again);
            const selfcal_status_t status = restore(&other, &again);
            if (status == SELFCAL_OK) {
                run(&other, 0, 60); /* a batch and more */
            } else {
                TEST_ASSERT_EQUAL(SELFCAL_CORRUPT, status);
                refusals++;
            }
        }
    }
    TEST_ASSERT_TRUE(refusals > end / 3U);
}

/* The optional parts that a model may name, each with what it adds to a bank's state. */
typedef struct {
    const char *name;
    const selfcal_handling_t *handling;
    const selfcal_regressors_t *regressors;
    const selfcal_forgetting_t *forgetting;
} parts_t;

enum { COLUMNS = 2 };
static const float reference[COLUMNS] = {0.0F, 25.0F}, coefficient_sd[COLUMNS] = {1e-3F, 1e-2F};
static const float ln_odds[COLUMNS] = {0.0F, -1.0F};
static const selfcal_handling_t handles = {6.0F, true, true}, keeps_outliers_out = {6.0F, false, false};
static const selfcal_regressors_t regressors = {
    .code = &selfcal_regressors_code,
    .count = COLUMNS,
    .reference = reference,
    .coefficient_sd = coefficient_sd,
    .ln_odds = ln_odds,
};
static const selfcal_forgetting_t forgets = {&selfcal_forgetting_code, 4.0F * SELFCAL_BATCH};
static const parts_t optional_parts[] = {
    {"handling", &handles, NULL, NULL},
    {"regressors", NULL, &regressors, NULL},
    {"forgetting", NULL, NULL, &forgets},
    {"handling and forgetting", &handles, NULL, &forgets},
    {"outliers, regressors and forgetting", &keeps_outliers_out, &regressors, &forgets},
};

/* The model's adequacy and its changes beside the bank: they are no part of a snapshot, and watch the bank from the
 * moment of its return. */
static selfcal_adequacy_t adequacy;
static selfcal_changes_t changes;
static float learned[SELFCAL_MODEL_NODES];

static void begin_watch(const bank_t *of) {
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_adequacy_init(&adequacy, &of->self));
    if (model.handling != NULL && model.handling->steps) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_changes_init(&changes, &adequacy, &of->self, learned));
    }
}

/* Samples and a gap through every optional part. */
static void run_parts(bank_t *to, uint32_t from, uint32_t until) {
    for (uint32_t i = from; i < until; i++) {
        const float sample[1] = {0.25F + 0.02F * noise(i)}, values[COLUMNS] = {(float)i, 25.0F + 0.01F * (float)i};
        const float *columns = model.regressors != NULL ? values : NULL;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push_with(&to->self, sample, columns));
        selfcal_adequacy_push(&adequacy, &to->self, NULL, columns);
        if (adequacy.changes != NULL) {
            (void)selfcal_changes_handle(&adequacy, &to->self);
        }
        if (i % 23U == 11U) {
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&to->self, 2U * BLOCK));
        }
    }
}

/* What follows upon a restore: samples, a view of the sums and, where the model handles steps, a new bias. */
static void use_parts(bank_t *of) {
    begin_watch(of);
    run_parts(of, 0, (SELFCAL_BATCH + 4U) * BLOCK);
    selfcal_node_view_t view;
    if (selfcal_node(&of->self, 0, (uint16_t)(model.nodes - 1U), &view) == SELFCAL_OK && model.handling != NULL &&
        model.regressors == NULL) {
        const selfcal_reopening_t at[1] = {{.hypothesis = 1}};
        (void)selfcal_reopen(&of->self, at, 0.5F, NULL);
        run_parts(of, 0, 2U * BLOCK);
    }
}

/* Each word of the image in turn, a member or a part of one, becomes one half, no number, the least and the greatest
 * integer, the greatest float, 2^1023. */
static void hostile_members_of_every_optional_part_are_refused_or_harmless(void) {
    static const uint32_t hostile[] = {0x3FE00000U, 0x7FC00000U, 0U, 0xFFFFFFFFU, 0x7F7FFFFFU, 0x7FE00000U};
    for (size_t k = 0; k < sizeof optional_parts / sizeof optional_parts[0]; k++) {
        model = selfcal_model;
        model.block = BLOCK;
        model.dt_s = 1.0F;
        make_small();
        model.handling = optional_parts[k].handling;
        model.regressors = optional_parts[k].regressors;
        model.forgetting = optional_parts[k].forgetting;
        begin(&bank);
        begin_watch(&bank);
        run_parts(&bank, 0, (3U * SELFCAL_BATCH + 5U) * BLOCK + 1U);
        TEST_ASSERT_EQUAL(SELFCAL_OK, save(&bank, &saved));
        TEST_ASSERT_EQUAL(SELFCAL_OK, restore(&other, &saved));
        use_parts(&other);
        uint32_t refusals = 0U, trials = 0U;
        for (size_t at = OFFSET_N; at + 8U <= saved.length; at += 4U) {
            for (size_t h = 0; h < sizeof hostile / sizeof hostile[0]; h++) {
                again = saved;
                for (unsigned i = 0; i < 4U; i++) {
                    again.bytes[at + i] = (uint8_t)(hostile[h] >> (8U * i));
                }
                mend_crc(&again);
                trials++;
                const selfcal_status_t status = restore(&other, &again);
                if (status == SELFCAL_OK) {
                    use_parts(&other);
                } else {
                    TEST_ASSERT_EQUAL_MESSAGE(SELFCAL_CORRUPT, status, optional_parts[k].name);
                    refusals++;
                }
            }
        }
        TEST_ASSERT_TRUE_MESSAGE(trials > 2000U && refusals > trials / 4U, optional_parts[k].name);
    }
}

/* A model that forgets nothing has no code that fades: sums of which a part is kept are not its own. */
static void a_part_kept_without_forgetting_is_refused(void) {
    for (size_t k = 0; k < sizeof optional_parts / sizeof optional_parts[0]; k++) {
        model = selfcal_model;
        model.block = BLOCK;
        model.dt_s = 1.0F;
        make_small();
        model.handling = optional_parts[k].handling;
        model.regressors = optional_parts[k].regressors;
        model.forgetting = optional_parts[k].forgetting;
        const selfcal_status_t expected = model.forgetting != NULL ? SELFCAL_OK : SELFCAL_CORRUPT;
        begin(&bank);
        begin_watch(&bank);
        run_parts(&bank, 0, (3U * SELFCAL_BATCH + 5U) * BLOCK + 1U);
        bank.self.keep = 0.75;
        TEST_ASSERT_EQUAL_MESSAGE(expected, selfcal_check(&bank.self), optional_parts[k].name);
        bank.self.keep = 1.0;
        bank.self.beginning = 0.75;
        TEST_ASSERT_EQUAL_MESSAGE(expected, selfcal_check(&bank.self), optional_parts[k].name);
    }
}

static void a_corrupt_bank_is_not_saved(void) {
    begin_small_pair();
    gathered(&bank)->count = SELFCAL_BATCH;
    TEST_ASSERT_EQUAL(SELFCAL_CORRUPT, save(&bank, &saved));
    TEST_ASSERT_EQUAL(0, saved.calls);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(restored_anywhere_and_continued_equals_uninterrupted);
    RUN_TEST(every_byte_of_the_bank_comes_back);
    RUN_TEST(saving_changes_nothing);
    RUN_TEST(the_format_is_the_one_described);
    RUN_TEST(any_alignment_will_do);
    RUN_TEST(every_single_bit_flip_is_refused);
    RUN_TEST(every_truncation_is_refused);
    RUN_TEST(erased_and_zeroed_memory_is_foreign);
    RUN_TEST(other_models_builds_and_versions_are_refused);
    RUN_TEST(bad_arguments_change_nothing);
    RUN_TEST(a_write_that_fails_ends_the_save);
    RUN_TEST(contents_that_no_bank_can_have_are_refused);
    RUN_TEST(hostile_contents_are_refused_or_harmless);
    RUN_TEST(hostile_members_of_every_optional_part_are_refused_or_harmless);
    RUN_TEST(a_part_kept_without_forgetting_is_refused);
    RUN_TEST(a_corrupt_bank_is_not_saved);
    return UNITY_END();
}
