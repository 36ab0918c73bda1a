#include "slcan_line.h"

static bool put(byte_ring_t *ring, const char *bytes, uint32_t count) {
    const uint32_t head = ring->head;
    if (ring->size - (head - ring->tail) < count) {
        return false;
    }
    for (uint32_t i = 0; i < count; i++) {
        ring->byte[(head + i) % ring->size] = (uint8_t)bytes[i];
    }
    ring->head = head + count; /* last: the handler may look at any time */
    return true;
}

static bool take(byte_ring_t *ring, uint8_t *byte) {
    const uint32_t tail = ring->tail;
    if (tail == ring->head) {
        return false;
    }
    *byte = ring->byte[tail % ring->size];
    ring->tail = tail + 1U;
    return true;
}

bool slcan_line_send(slcan_line_t *line, const selfcal_frame_t *frame) {
    if (!line->slcan.open) {
        line->dropped++;
        return true;
    }
    char text[SLCAN_FRAME_BYTES];
    slcan_encode(frame, text);
    return put(&line->out, text, sizeof text);
}

bool slcan_line_poll(slcan_line_t *line) {
    uint8_t byte;
    while (take(&line->in, &byte)) {
        char answer[SLCAN_ANSWER_BYTES];
        const size_t count = slcan_receive(&line->slcan, byte, answer);
        (void)put(&line->out, answer, (uint32_t)count);
#ifdef APP_COMMAND_KEY
        if (line->slcan.came) {
            line->slcan.came = false;
            return true;
        }
#endif
    }
    return false;
}

bool slcan_line_empty(const slcan_line_t *line) {
    return line->out.tail == line->out.head;
}

void slcan_line_received(slcan_line_t *line, uint8_t byte) {
    const uint32_t head = line->in.head;
    if (head - line->in.tail < line->in.size) {
        line->in.byte[head % line->in.size] = byte;
        line->in.head = head + 1U;
    } else {
        line->lost++;
    }
}

bool slcan_line_next(slcan_line_t *line, uint8_t *byte) {
    return take(&line->out, byte);
}
