/* Snapshot: all that a bank knows, as bytes.
 *
 * Format 1, little-endian, without padding. Reals are IEEE 754 bit patterns, a bool is one byte, 0 or 1.
 *        0  4  "SFCL"
 *        4  4  bytes of the whole, checksum included
 *        8  2  format version
 *       10  1  arithmetic: 4 float, 8 double (selfcal_real_t), 16 or 32 integers (SELFCAL_FIXED)
 *       11  1  axes of the model
 *       12  2  nodes of the model
 *       14  2  0
 *       16  4  id of the model
 *       20  4  layout: CRC-32 over kind (1 byte) and count (2 bytes) of every field below, so that a build with other fields or
 *              other maxima of the configuration is told apart without anyone counting up the version
 *       24     selfcal_t, its batches, its counters, every node, b, c, x, number formats, what the
 *              regressors and the sums have: the fields below, in their order
 *     last  4  CRC-32 of all before (IEEE 802.3: reflected polynomial 0xEDB88320, start and final inversion 0xFFFFFFFF)
 * The first 8 bytes and the checksum are where they are in every version.
 *
 * A field is added to selfcal_t or selfcal_node_t and to its list here; the assertions below fail to compile until it is. The
 * version counts up when what a field means changes, or the header. */
#include <float.h>

#include "internal.h"

#define VERSION 1U
#ifdef SELFCAL_FIXED
#define ARITHMETIC SELFCAL_FIXED
#else
#define ARITHMETIC sizeof(selfcal_real_t)
#endif
enum { HEADER = 24, TRAILER = 4 };
static const uint8_t magic[4] = {'S', 'F', 'C', 'L'};

/* ------------------------------------------------------------------------------------------------------------ fields */

typedef enum { KIND_BOOL, KIND_U8, KIND_U16, KIND_U32, KIND_U64, KIND_FLOAT, KIND_REAL, KIND_WIDE, KINDS } kind_t;

#define TYPE_BOOL bool
#define TYPE_U8 uint8_t
#define TYPE_U16 uint16_t
#define TYPE_U32 uint32_t
#define TYPE_U64 uint64_t
#define TYPE_FLOAT float
#define TYPE_REAL selfcal_real_t
#define TYPE_WIDE selfcal_wide_t

static const uint8_t kind_size[KINDS] = {
    sizeof(TYPE_BOOL), sizeof(TYPE_U8),    sizeof(TYPE_U16),  sizeof(TYPE_U32),
    sizeof(TYPE_U64),  sizeof(TYPE_FLOAT), sizeof(TYPE_REAL), sizeof(TYPE_WIDE),
};

/* In the order of the structs. F: every member but the pointers, which selfcal_init() sets; PART: structs with a list of
 * their own. A selfcal_sum_t is two reals; signed numbers are the bits of unsigned ones. */
#ifdef SELFCAL_FIXED
#define FIXED_BANK_FIELDS(F, PART)          \
    PART(selfcal_t, scale, selfcal_scale_t) \
    F(selfcal_t, y_fixed, U32)              \
    F(selfcal_t, step, U32)                 \
    F(selfcal_t, step_from, U32)            \
    F(selfcal_t, step_to, U32)              \
    F(selfcal_t, step_beta, FLOAT)          \
    F(selfcal_t, step_floored, BOOL)

#define FIXED_NODE_SHIFTS(F)       \
    F(selfcal_node_t, g_shift, U8) \
    F(selfcal_node_t, u_shift, U8) \
    F(selfcal_node_t, w_shift, U8)

#define BLOCK_FIELDS(F, PART) PART(selfcal_t, sums, selfcal_block_t)

#define BLOCK_SUM_FIELDS(F)           \
    F(selfcal_block_t, sum, U64)      \
    F(selfcal_block_t, sum_sq, U64)   \
    F(selfcal_block_t, first, U32)    \
    F(selfcal_block_t, exponent, U16) \
    F(selfcal_block_t, shift, U8)

#define SCALE_FIELDS(F)               \
    F(selfcal_scale_t, exponent, U16) \
    F(selfcal_scale_t, coarser, U16)  \
    F(selfcal_scale_t, finer, U16)    \
    F(selfcal_scale_t, most_y, U32)   \
    F(selfcal_scale_t, most_sum, U32)
#else
#define FIXED_BANK_FIELDS(F, PART)
#define FIXED_NODE_SHIFTS(F)
#define SCALE_FIELDS(F)
#define BLOCK_FIELDS(F, PART)   \
    F(selfcal_t, first, FLOAT)  \
    F(selfcal_t, sum, REAL)     \
    F(selfcal_t, sum_sq, REAL)
#endif

#define BANK_FIELDS(F, PART)                      \
    F(selfcal_t, n, U32)                          \
    F(selfcal_t, weight, WIDE)                    \
    F(selfcal_t, keep, WIDE)                      \
    F(selfcal_t, beginning, WIDE)                 \
    F(selfcal_t, rho_lo, REAL)                    \
    F(selfcal_t, rho_step, REAL)                  \
    F(selfcal_t, alpha_lo, REAL)                  \
    F(selfcal_t, alpha_step, REAL)                \
    PART(selfcal_t, batch, selfcal_batch_t)       \
    F(selfcal_t, gathering, U8)                   \
    F(selfcal_t, ran, U16)                        \
    F(selfcal_t, push_nodes, U16)                 \
    F(selfcal_t, pending_gap, U32)                \
    F(selfcal_t, batches, U32)                    \
    FIXED_BANK_FIELDS(F, PART)                    \
    F(selfcal_t, started, BOOL)                   \
    F(selfcal_t, origin, FLOAT)                   \
    F(selfcal_t, offset, REAL)                    \
    F(selfcal_t, block, U32)                      \
    F(selfcal_t, variance_ratio, REAL)            \
    BLOCK_FIELDS(F, PART)                         \
    F(selfcal_t, position, U32)                   \
    F(selfcal_t, used, U32)                       \
    F(selfcal_t, dropped, BOOL)                   \
    F(selfcal_t, within, WIDE)                    \
    F(selfcal_t, within_dof, U64)                 \
    F(selfcal_t, last, FLOAT)                     \
    F(selfcal_t, equal, U32)                      \
    F(selfcal_t, in_gap, BOOL)                    \
    F(selfcal_t, shifted, FLOAT)                  \
    F(selfcal_t, retired, U32)                    \
    F(selfcal_t, watched, U32)                    \
    F(selfcal_t, bad, U32)                        \
    F(selfcal_t, bad_blocks, U32)                 \
    PART(selfcal_t, counters, selfcal_counters_t)

#define BATCH_FIELDS(F)                \
    F(selfcal_batch_t, y, REAL)        \
    F(selfcal_batch_t, r, REAL)        \
    F(selfcal_batch_t, gap, U32)       \
    F(selfcal_batch_t, gap_after, U32) \
    F(selfcal_batch_t, count, U32)     \
    F(selfcal_batch_t, part, BOOL)

#define COUNTER_FIELDS(F)                     \
    F(selfcal_counters_t, samples, U64)       \
    F(selfcal_counters_t, missing, U64)       \
    F(selfcal_counters_t, gaps, U32)          \
    F(selfcal_counters_t, blocks_lost, U32)   \
    F(selfcal_counters_t, blocks_part, U32)   \
    F(selfcal_counters_t, blocks_moving, U32) \
    F(selfcal_counters_t, not_finite, U32)    \
    F(selfcal_counters_t, saturated, U32)     \
    F(selfcal_counters_t, stuck, U32)         \
    F(selfcal_counters_t, regressor_not_finite, U32)

#define NODE_FIELDS(F)                 \
    F(selfcal_node_t, beta, REAL)      \
    F(selfcal_node_t, q, REAL)         \
    F(selfcal_node_t, p_inf, REAL)     \
    F(selfcal_node_t, u_inf, REAL)     \
    F(selfcal_node_t, gains, REAL)     \
    F(selfcal_node_t, level, BOOL)     \
    FIXED_NODE_SHIFTS(F)               \
    F(selfcal_node_t, steady, U32)     \
    F(selfcal_node_t, level_from, U32) \
    F(selfcal_node_t, a, REAL)         \
    F(selfcal_node_t, ln_s, REAL)

#define COLUMN_FIELDS(F)               \
    F(selfcal_column_t, z, REAL)       \
    F(selfcal_column_t, last, REAL)    \
    F(selfcal_column_t, origin, FLOAT) \
    F(selfcal_column_t, first, FLOAT)  \
    F(selfcal_column_t, offset, REAL)  \
    F(selfcal_column_t, sum, REAL)

#if SELFCAL_TERMS_MAX > 1
#define TERM_FIELDS(F)                  \
    F(selfcal_term_node_t, p, WIDE)     \
    F(selfcal_term_node_t, beta, REAL)  \
    F(selfcal_term_node_t, q, REAL)     \
    F(selfcal_term_node_t, theta, REAL) \
    F(selfcal_term_node_t, steady, BOOL)
#endif

/* What a part of the bank is made of. */
typedef struct {
    uint16_t offset, count;
    uint8_t kind;
} field_t;

/* NOLINTBEGIN(bugprone-sizeof-expression): a count of one is a quotient of equal sizes. */
#define COUNT(struct_t, member, kind) (sizeof(((struct_t *)0)->member) / sizeof(TYPE_##kind))
#define ROW(struct_t, member, kind) {offsetof(struct_t, member), COUNT(struct_t, member, kind), KIND_##kind},
#define NO_ROW(struct_t, member, type)
#define LENGTH(array) (sizeof(array) / sizeof((array)[0]))

static const field_t bank_fields[] = {BANK_FIELDS(ROW, NO_ROW)};
static const field_t batch_fields[] = {BATCH_FIELDS(ROW)};
static const field_t counter_fields[] = {COUNTER_FIELDS(ROW)};
static const field_t node_fields[] = {NODE_FIELDS(ROW)};
static const field_t column_fields[] = {COLUMN_FIELDS(ROW)};
#if SELFCAL_TERMS_MAX > 1
static const field_t term_fields[] = {TERM_FIELDS(ROW)};
#endif
static const field_t sum_fields[] = {{0, 2, KIND_REAL}};
#ifdef SELFCAL_FIXED
static const field_t scale_fields[] = {SCALE_FIELDS(ROW)};
static const field_t block_fields[] = {BLOCK_SUM_FIELDS(ROW)};
static const field_t total_fields[] = {{0, 1, KIND_U64}}, drift_fields[] = {{0, 1, KIND_U32}};
#else
static const field_t total_fields[] = {{0, 2, KIND_REAL}}, drift_fields[] = {{0, 1, KIND_REAL}};
static const field_t real_fields[] = {{0, 1, KIND_REAL}};
#endif

/* The structs once more, from the lists alone: as large as the real ones, every member in its place. (What these cannot see is a
 * bool that slips into padding; a test compares the bytes.) */
#define MIRROR(struct_t, member, kind) TYPE_##kind member[COUNT(struct_t, member, kind)];
#define MIRROR_PART(struct_t, member, type) type member[sizeof(((struct_t *)0)->member) / sizeof(type)];
typedef struct {
#if SELFCAL_TERMS_MAX > 1
    const void *pointer[7]; /* as below, and terms */
#else
    const void *pointer[6]; /* model, columns, node, b, c, x */
#endif
    BANK_FIELDS(MIRROR, MIRROR_PART)
} selfcal_t_mirror;
typedef struct {
    BATCH_FIELDS(MIRROR)
} selfcal_batch_t_mirror;
typedef struct {
    COUNTER_FIELDS(MIRROR)
} selfcal_counters_t_mirror;
typedef struct {
    NODE_FIELDS(MIRROR)
} selfcal_node_t_mirror;
typedef struct {
    COLUMN_FIELDS(MIRROR)
} selfcal_column_t_mirror;
#if SELFCAL_TERMS_MAX > 1
typedef struct {
    TERM_FIELDS(MIRROR)
} selfcal_term_node_t_mirror;
#endif
#ifdef SELFCAL_FIXED
typedef struct {
    SCALE_FIELDS(MIRROR)
} selfcal_scale_t_mirror;
typedef struct {
    BLOCK_SUM_FIELDS(MIRROR)
} selfcal_block_t_mirror;
#endif
/* NOLINTEND(bugprone-sizeof-expression) */

#define IN_PLACE(struct_t, member, kind) \
    SELFCAL_STATIC_ASSERT(struct_t##_##member, offsetof(struct_t, member) == offsetof(struct_t##_mirror, member));
BANK_FIELDS(IN_PLACE, IN_PLACE)
BATCH_FIELDS(IN_PLACE)
COUNTER_FIELDS(IN_PLACE)
NODE_FIELDS(IN_PLACE)
COLUMN_FIELDS(IN_PLACE)
SELFCAL_STATIC_ASSERT(all_of_the_bank, sizeof(selfcal_t) == sizeof(selfcal_t_mirror));
SELFCAL_STATIC_ASSERT(all_of_a_batch, sizeof(selfcal_batch_t) == sizeof(selfcal_batch_t_mirror));
SELFCAL_STATIC_ASSERT(all_of_the_counters, sizeof(selfcal_counters_t) == sizeof(selfcal_counters_t_mirror));
SELFCAL_STATIC_ASSERT(all_of_a_node, sizeof(selfcal_node_t) == sizeof(selfcal_node_t_mirror));
SELFCAL_STATIC_ASSERT(all_of_a_column, sizeof(selfcal_column_t) == sizeof(selfcal_column_t_mirror));
SELFCAL_STATIC_ASSERT(all_of_the_columns, sizeof(selfcal_columns_t) == 5 * sizeof(void *));
#if SELFCAL_TERMS_MAX > 1
TERM_FIELDS(IN_PLACE)
SELFCAL_STATIC_ASSERT(all_of_a_term_node, sizeof(selfcal_term_node_t) == sizeof(selfcal_term_node_t_mirror));
#ifdef SELFCAL_FIXED
SELFCAL_STATIC_ASSERT(all_of_the_terms, sizeof(selfcal_terms_t) == 3 * sizeof(void *));
#else
SELFCAL_STATIC_ASSERT(all_of_the_terms, sizeof(selfcal_terms_t) == 2 * sizeof(void *));
#endif
#endif
SELFCAL_STATIC_ASSERT(all_of_a_sum, sizeof(selfcal_sum_t) == 2 * sizeof(selfcal_real_t));
#ifdef SELFCAL_FIXED
SCALE_FIELDS(IN_PLACE)
BLOCK_SUM_FIELDS(IN_PLACE)
SELFCAL_STATIC_ASSERT(all_of_a_scale, sizeof(selfcal_scale_t) == sizeof(selfcal_scale_t_mirror));
SELFCAL_STATIC_ASSERT(all_of_a_block, sizeof(selfcal_block_t) == sizeof(selfcal_block_t_mirror));
SELFCAL_STATIC_ASSERT(all_of_a_total, sizeof(selfcal_total_t) == 8);
SELFCAL_STATIC_ASSERT(all_of_a_drift, sizeof(selfcal_drift_t) == 4);
#else
SELFCAL_STATIC_ASSERT(all_of_a_total, sizeof(selfcal_total_t) == 2 * sizeof(selfcal_real_t));
SELFCAL_STATIC_ASSERT(all_of_a_drift, sizeof(selfcal_drift_t) == sizeof(selfcal_real_t));
#endif
SELFCAL_STATIC_ASSERT(float_is_ieee_single, sizeof(float) == 4 && FLT_MANT_DIG == 24 && FLT_MAX_EXP == 128);
SELFCAL_STATIC_ASSERT(wide_is_ieee_double, sizeof(selfcal_wide_t) == 8 && DBL_MANT_DIG == 53 && DBL_MAX_EXP == 1024);
SELFCAL_STATIC_ASSERT(bool_is_a_byte, sizeof(bool) == 1);

/* Records of one kind in a row. */
typedef struct {
    const field_t *field;
    size_t fields;
    const void *record;
    size_t records, stride;
} part_t;

#ifdef SELFCAL_FIXED
enum { PARTS = 14 + (SELFCAL_TERMS_MAX > 1 ? 3 : 0) };
#else
enum { PARTS = 12 + (SELFCAL_TERMS_MAX > 1 ? 2 : 0) };
#endif

/* The parts of a bank of `model`; without `self`, their sizes alone. */
static void parts_of(const selfcal_model_t *model, const selfcal_t *self, part_t part[PARTS]) {
    const size_t nodes = model->nodes, cells = nodes * model->axes;
    const bool there = self != NULL;
    const size_t p = model->regressors != NULL ? model->regressors->count : 0U, used = p > 0U ? 1U : 0U;
    const selfcal_columns_t *columns = there ? self->columns : NULL;
    const bool more = columns != NULL;
#if SELFCAL_TERMS_MAX > 1
    const size_t sums = selfcal_terms_nodes(model);
    const selfcal_terms_t *terms = there ? self->terms : NULL;
    const bool sum = terms != NULL;
#endif
    const part_t parts[PARTS] = {
        {bank_fields, LENGTH(bank_fields), self, 1, sizeof *self},
        {batch_fields, LENGTH(batch_fields), there ? self->batch : NULL, LENGTH(self->batch), sizeof self->batch[0]},
        {counter_fields, LENGTH(counter_fields), there ? &self->counters : NULL, 1, sizeof self->counters},
        {node_fields, LENGTH(node_fields), there ? self->node : NULL, nodes, sizeof *self->node},
        {total_fields, LENGTH(total_fields), there ? self->b : NULL, cells, sizeof *self->b},
        {total_fields, LENGTH(total_fields), there ? self->c : NULL, cells, sizeof *self->c},
        {drift_fields, LENGTH(drift_fields), there ? self->x : NULL, cells, sizeof *self->x},
#ifdef SELFCAL_FIXED
        {scale_fields, LENGTH(scale_fields), there ? self->scale : NULL, LENGTH(self->scale), sizeof self->scale[0]},
        {block_fields, LENGTH(block_fields), there ? self->sums : NULL, LENGTH(self->sums), sizeof self->sums[0]},
#endif
        {column_fields, LENGTH(column_fields), more ? columns->column : NULL, p, sizeof *columns->column},
        {sum_fields, 1, more ? columns->a : NULL, used * nodes * SELFCAL_REGRESSORS_ROWS(p + 1U), sizeof *columns->a},
        {sum_fields, 1, more ? columns->b : NULL, cells * p, sizeof *columns->b},
        {sum_fields, 1, more ? columns->x : NULL, used * nodes * (p + 1U), sizeof *columns->x},
#ifdef SELFCAL_FIXED
        {sum_fields, 1, more ? columns->reading : NULL, 3U * used * cells, sizeof *columns->reading},
#else
        {real_fields, 1, more ? columns->low : NULL, used * cells, sizeof *columns->low},
#endif
#if SELFCAL_TERMS_MAX > 1
        {term_fields, LENGTH(term_fields), sum ? terms->node : NULL, sums, sizeof *terms->node},
        {sum_fields, 1, sum ? terms->x : NULL, sums * (1U + p + model->axes) * SELFCAL_TERMS_MAX, sizeof *terms->x},
#ifdef SELFCAL_FIXED
        {sum_fields, 1, sum ? terms->bc : NULL, sums * model->axes * 2U, sizeof *terms->bc},
#endif
#endif
    };
    memcpy(part, parts, sizeof parts);
}

static size_t size_of(const selfcal_model_t *model) {
    part_t part[PARTS];
    parts_of(model, NULL, part);
    size_t total = HEADER + TRAILER;
    for (size_t p = 0; p < PARTS; p++) {
        for (size_t f = 0; f < part[p].fields; f++) {
            total += part[p].records * part[p].field[f].count * kind_size[part[p].field[f].kind];
        }
    }
    return total;
}

/* ------------------------------------------------------------------------------------------------------------- bytes */

/* Four bits a step: a table of 64 bytes. */
static uint32_t crc32(uint32_t crc, const uint8_t *bytes, size_t count) {
    static const uint32_t table[16] = {
        0x00000000U, 0x1DB71064U, 0x3B6E20C8U, 0x26D930ACU, 0x76DC4190U, 0x6B6B51F4U, 0x4DB26158U, 0x5005713CU,
        0xEDB88320U, 0xF00F9344U, 0xD6D6A3E8U, 0xCB61B38CU, 0x9B64C2B0U, 0x86D3D2D4U, 0xA00AE278U, 0xBDBDF21CU,
    };
    crc = ~crc;
    for (size_t i = 0; i < count; i++) {
        crc ^= bytes[i];
        crc = (crc >> 4) ^ table[crc & 15U];
        crc = (crc >> 4) ^ table[crc & 15U];
    }
    return ~crc;
}

/* Where byte i, counted from the least significant one, of a number of `size` bytes lies in this machine's memory. */
static size_t place(size_t i, size_t size) {
    const uint16_t one = 1;
    uint8_t first;
    memcpy(&first, &one, 1);
    return first == 1U ? i : size - 1U - i;
}

static uint32_t number_at(const uint8_t *bytes, size_t size) {
    uint32_t number = 0;
    for (size_t i = size; i > 0U; i--) {
        number = number << 8 | bytes[i - 1U];
    }
    return number;
}

static uint32_t layout_of(const part_t part[PARTS]) {
    uint32_t crc = 0;
    for (size_t p = 0; p < PARTS; p++) {
        for (size_t f = 0; f < part[p].fields; f++) {
            const field_t *field = &part[p].field[f];
            const uint8_t bytes[3] = {field->kind, (uint8_t)field->count, (uint8_t)(field->count >> 8)};
            crc = crc32(crc, bytes, sizeof bytes);
        }
    }
    return crc;
}

/* -------------------------------------------------------------------------------------------------------------- save */

typedef struct {
    selfcal_write_t write;
    void *context;
    bool good;
    uint32_t crc; /* of what was written */
    size_t held;
    uint8_t chunk[SELFCAL_SNAPSHOT_CHUNK];
} sink_t;

static void flush(sink_t *sink) {
    sink->crc = crc32(sink->crc, sink->chunk, sink->held);
    sink->good = sink->good && sink->write(sink->context, sink->chunk, sink->held);
    sink->held = 0;
}

static void put(sink_t *sink, uint8_t byte) {
    sink->chunk[sink->held++] = byte;
    if (sink->held == sizeof sink->chunk) {
        flush(sink);
    }
}

static void put_number(sink_t *sink, size_t size, uint32_t number) {
    for (size_t i = 0; i < size; i++) {
        put(sink, (uint8_t)(number >> (8U * i)));
    }
}

static void put_record(sink_t *sink, const part_t *part, const uint8_t *record) {
    for (size_t f = 0; f < part->fields; f++) {
        const size_t size = kind_size[part->field[f].kind];
        const uint8_t *at = record + part->field[f].offset;
        for (size_t left = part->field[f].count; left > 0U; left--, at += size) {
            for (size_t i = 0; i < size; i++) {
                put(sink, at[place(i, size)]);
            }
        }
    }
}

size_t selfcal_snapshot_size(const selfcal_t *self) {
    return self != NULL ? size_of(self->model) : 0U;
}

selfcal_status_t selfcal_save(const selfcal_t *self, selfcal_write_t write, void *context) {
    if (self == NULL || write == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (selfcal_check(self) != SELFCAL_OK) {
        return SELFCAL_CORRUPT;
    }
    const selfcal_model_t *model = self->model;
    part_t part[PARTS];
    parts_of(model, self, part);
    sink_t sink = {.write = write, .context = context, .good = true};
    for (size_t i = 0; i < sizeof magic; i++) {
        put(&sink, magic[i]);
    }
    put_number(&sink, 4, (uint32_t)size_of(model));
    put_number(&sink, 2, VERSION);
    put_number(&sink, 1, ARITHMETIC);
    put_number(&sink, 1, model->axes);
    put_number(&sink, 2, model->nodes);
    put_number(&sink, 2, 0);
    put_number(&sink, 4, model->id);
    put_number(&sink, 4, layout_of(part));
    for (size_t p = 0; p < PARTS; p++) {
        for (size_t k = 0; k < part[p].records && sink.good; k++) {
            put_record(&sink, &part[p], (const uint8_t *)part[p].record + k * part[p].stride);
        }
    }
    put_number(&sink, TRAILER, crc32(sink.crc, sink.chunk, sink.held));
    if (sink.held > 0U) {
        flush(&sink);
    }
    return sink.good ? SELFCAL_OK : SELFCAL_WRITE_FAILED;
}

/* ----------------------------------------------------------------------------------------------------------- restore */

/* What the header and the checksum say. */
static selfcal_status_t inspect(const selfcal_model_t *model, const uint8_t *bytes, size_t length) {
    part_t part[PARTS];
    parts_of(model, NULL, part);
    if (length < HEADER + TRAILER) {
        return SELFCAL_SNAPSHOT_TRUNCATED;
    }
    if (memcmp(bytes, magic, sizeof magic) != 0) {
        return SELFCAL_SNAPSHOT_FOREIGN;
    }
    const uint32_t stated = number_at(bytes + 4, 4);
    if (length != stated) {
        return length < stated ? SELFCAL_SNAPSHOT_TRUNCATED : SELFCAL_SNAPSHOT_TOO_LONG;
    }
    if (number_at(bytes + length - TRAILER, TRAILER) != crc32(0, bytes, length - TRAILER)) {
        return SELFCAL_SNAPSHOT_DAMAGED;
    }
    if (number_at(bytes + 8, 2) != VERSION) {
        return SELFCAL_SNAPSHOT_VERSION;
    }
    if (bytes[10] != ARITHMETIC || bytes[11] != model->axes || number_at(bytes + 12, 2) != model->nodes ||
        number_at(bytes + 14, 2) != 0U || number_at(bytes + 16, 4) != model->id || number_at(bytes + 20, 4) != layout_of(part) ||
        length != size_of(model)) {
        return SELFCAL_SNAPSHOT_FOREIGN;
    }
    return SELFCAL_OK;
}

/* Fills a record; false if a bool is neither 0 nor 1. */
static bool get_record(const part_t *part, uint8_t *record, const uint8_t **bytes) {
    for (size_t f = 0; f < part->fields; f++) {
        const size_t size = kind_size[part->field[f].kind];
        uint8_t *at = record + part->field[f].offset;
        for (size_t left = part->field[f].count; left > 0U; left--, at += size) {
            if (part->field[f].kind == KIND_BOOL && **bytes > 1U) {
                return false;
            }
            for (size_t i = 0; i < size; i++) {
                at[place(i, size)] = *(*bytes)++;
            }
        }
    }
    return true;
}

selfcal_status_t selfcal_restore(selfcal_t *self, const selfcal_model_t *model, void *memory, size_t size, const void *snapshot,
                                 size_t length) {
    if (self == NULL || model == NULL || memory == NULL || snapshot == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    const uint8_t *bytes = snapshot;
    selfcal_status_t status = inspect(model, bytes, length);
    if (status == SELFCAL_OK) {
        status = selfcal_init(self, model, memory, size);
    }
    if (status != SELFCAL_OK) {
        return status;
    }
    bytes += HEADER;
    part_t part[PARTS];
    parts_of(model, self, part);
    bool good = true;
    for (size_t p = 0; p < PARTS; p++) {
        uint8_t *record = (uint8_t *)part[p].record;
        for (size_t k = 0; k < part[p].records && good; k++, record += part[p].stride) {
            good = get_record(&part[p], record, &bytes);
        }
    }
    if (!good || selfcal_check(self) != SELFCAL_OK) {
        (void)selfcal_init(self, model, memory, size);
        return SELFCAL_CORRUPT;
    }
    return SELFCAL_OK;
}
