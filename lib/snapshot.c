/* Snapshot: all that a bank knows, as bytes.
 *
 * Format 3. Numbers of the header and the checksum are little-endian.
 *        0  4  "SFCL"
 *        4  4  bytes of the whole, checksum included
 *        8  2  format version
 *       10  1  arithmetic: 4 float, 8 double (selfcal_real_t), 32 integers (SELFCAL_FIXED)
 *       11  1  axes of the model
 *       12  2  nodes of the model
 *       14  2  0
 *       16  4  id of the model
 *       20  4  layout: CRC-32 of sizes and places in the structs, of the configuration and of the byte order
 *       24     image: the bank's state as it lies in memory. It has no pointers: selfcal_t from `n` on; the nodes with
 *              their sums; the regressors' sums; the states of laws that are sums.
 *     last  4  CRC-32 of all before (IEEE 802.3: reflected polynomial 0xEDB88320, start and final inversion 0xFFFFFFFF)
 * The first 8 bytes and the checksum are where they are in every version.
 *
 * The version counts up when the meaning of a member changes, or the header. */
#include "bank_inside.h"

#define VERSION 3U
enum { HEADER = 24, TRAILER = 4 };
static const uint8_t magic[4] = {'S', 'F', 'C', 'L'};

/* Bytes of the bank that are in the image. */
typedef struct {
    const void *from;
    size_t bytes;
} part_t;

enum { PARTS = 4 };

/* Without `self`, their sizes alone. */
static void parts_of(const selfcal_model_t *model, const selfcal_t *self, part_t part[PARTS]) {
    const size_t nodes = model->nodes, axes = model->axes, p = regressors_of(model), sums = sum_nodes(model);
    const size_t columns = SELFCAL_REGRESSORS_SIZE(nodes, axes, p), states = SELFCAL_TERMS_SIZE(sums, axes, p);
    memset(part, 0, PARTS * sizeof part[0]);
    part[0].bytes = sizeof(selfcal_t) - offsetof(selfcal_t, n);
    part[1].bytes = SELFCAL_SIZE(nodes, axes);
    part[2].bytes = p > 0U ? columns - 7U - sizeof(selfcal_columns_t) : 0U;
    part[3].bytes = sums > 0U ? states - 7U - sizeof(selfcal_terms_t) : 0U;
    if (self != NULL) {
        part[0].from = (const uint8_t *)self + offsetof(selfcal_t, n);
        part[1].from = self->b;
        part[2].from = p > 0U ? self->columns->column : NULL;
        part[3].from = sums > 0U ? self->terms->node : NULL;
    }
}

static size_t size_of(const selfcal_model_t *model) {
    part_t part[PARTS];
    parts_of(model, NULL, part);
    return HEADER + part[0].bytes + part[1].bytes + part[2].bytes + part[3].bytes + TRAILER;
}

/* --- bytes --- */

/* Four bits a step: a table of 64 bytes. */
uint32_t selfcal_crc32(uint32_t crc, const uint8_t *bytes, size_t count) {
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

static uint32_t number_at(const uint8_t *bytes, size_t size) {
    uint32_t number = 0;
    for (size_t i = size; i > 0U; i--) {
        number = number << 8 | bytes[i - 1U];
    }
    return number;
}

/* Facts of the build. An image of other facts is refused. */
static uint32_t facts_of_build(void) {
    const uint32_t facts[] = {
        sizeof(void *),
        sizeof(selfcal_t),
        offsetof(selfcal_t, n),
        offsetof(selfcal_t, batch),
        offsetof(selfcal_t, integers),
        offsetof(selfcal_t, started),
        offsetof(selfcal_t, sums),
        offsetof(selfcal_t, counters),
        sizeof(selfcal_batch_t),
        sizeof(selfcal_integers_t),
        sizeof(selfcal_node_t),
        sizeof(selfcal_total_t),
        sizeof(selfcal_drift_t),
        sizeof(selfcal_column_t),
        sizeof(selfcal_reading_t),
        sizeof(selfcal_term_node_t),
        SELFCAL_AXES_MAX,
        SELFCAL_HYPOTHESES_MAX,
        SELFCAL_BATCH,
        SELFCAL_TERMS_MAX,
    };
    return selfcal_crc32(0, (const uint8_t *)facts,
                         sizeof facts); /* of these bytes as they lie: the order of bytes is in it */
}

/* --- save --- */

typedef struct {
    selfcal_write_t write;
    void *context;
    bool good;
    uint32_t crc; /* of what was written */
    size_t held;
    uint8_t chunk[SELFCAL_SNAPSHOT_CHUNK];
} sink_t;

static void flush(sink_t *sink) {
    sink->crc = selfcal_crc32(sink->crc, sink->chunk, sink->held);
    sink->good = sink->good && sink->write(sink->context, sink->chunk, sink->held);
    sink->held = 0;
}

static void put(sink_t *sink, const uint8_t *bytes, size_t count) {
    for (size_t i = 0; i < count && sink->good; i++) {
        sink->chunk[sink->held++] = bytes[i];
        if (sink->held == sizeof sink->chunk) {
            flush(sink);
        }
    }
}

static void put_number(sink_t *sink, size_t size, uint32_t number) {
    const uint8_t bytes[4] = {(uint8_t)number, (uint8_t)(number >> 8), (uint8_t)(number >> 16),
                              (uint8_t)(number >> 24)};
    put(sink, bytes, size);
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
    put(&sink, magic, sizeof magic);
    put_number(&sink, 4, (uint32_t)size_of(model));
    put_number(&sink, 2, VERSION);
    put_number(&sink, 1, SELFCAL_ARITHMETIC);
    put_number(&sink, 1, model->axes);
    put_number(&sink, 2, model->nodes);
    put_number(&sink, 2, 0);
    put_number(&sink, 4, model->id);
    put_number(&sink, 4, facts_of_build());
    for (size_t p = 0; p < PARTS; p++) {
        put(&sink, part[p].from, part[p].bytes);
    }
    put_number(&sink, TRAILER, selfcal_crc32(sink.crc, sink.chunk, sink.held));
    if (sink.held > 0U) {
        flush(&sink);
    }
    return sink.good ? SELFCAL_OK : SELFCAL_WRITE_FAILED;
}

/* --- restore --- */

/* Judges the header and the checksum. */
static selfcal_status_t inspect(const selfcal_model_t *model, const uint8_t *bytes, size_t length) {
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
    if (number_at(bytes + length - TRAILER, TRAILER) != selfcal_crc32(0, bytes, length - TRAILER)) {
        return SELFCAL_SNAPSHOT_DAMAGED;
    }
    if (number_at(bytes + 8, 2) != VERSION) {
        return SELFCAL_SNAPSHOT_VERSION;
    }
    if (bytes[10] != SELFCAL_ARITHMETIC || bytes[11] != model->axes || number_at(bytes + 12, 2) != model->nodes ||
        number_at(bytes + 14, 2) != 0U || number_at(bytes + 16, 4) != model->id ||
        number_at(bytes + 20, 4) != facts_of_build() || length != size_of(model)) {
        return SELFCAL_SNAPSHOT_FOREIGN;
    }
    return SELFCAL_OK;
}

selfcal_status_t selfcal_restore_as(uint32_t layout, selfcal_t *self, const selfcal_model_t *model, void *memory,
                                    size_t size, const void *snapshot, size_t length) {
    if (layout != SELFCAL_LAYOUT) {
        return SELFCAL_BAD_BUILD;
    }
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
    parts_of(model, NULL, part);
    void *const to[PARTS] = {
        (uint8_t *)self + offsetof(selfcal_t, n),
        self->b,
        part[2].bytes > 0U ? self->columns->column : NULL,
        part[3].bytes > 0U ? self->terms->node : NULL,
    };
    for (size_t p = 0; p < PARTS; p++) {
        if (part[p].bytes > 0U) {
            memcpy(to[p], bytes, part[p].bytes);
        }
        bytes += part[p].bytes;
    }
    if (selfcal_check(self) != SELFCAL_OK) { /* a bool that is neither 0 nor 1 is found there too */
        (void)selfcal_init(self, model, memory, size);
        return SELFCAL_CORRUPT;
    }
    return SELFCAL_OK;
}
