#include "slcan.h"

#include <string.h>

#ifdef APP_COMMAND_KEY
#include "command.h"
#endif

#define CR '\r'
#define LF '\n'
#define BEL '\a'

void slcan_init(slcan_t *self) {
    memset(self, 0, sizeof *self);
}

static size_t reply(char answer[SLCAN_ANSWER_BYTES], const char *text) {
    size_t length = 0;
    for (; text[length] != '\0'; length++) {
        answer[length] = text[length];
    }
    return length;
}

#ifdef APP_COMMAND_KEY
/* -1: none. */
static int digit_value(char digit) {
    return digit >= '0' && digit <= '9'   ? digit - '0'
           : digit >= 'A' && digit <= 'F' ? digit - 'A' + 10
           : digit >= 'a' && digit <= 'f' ? digit - 'a' + 10
                                          : -1;
}

/* Takes a line that is a COMMAND message of 8 bytes. */
static bool take_command(slcan_t *self) {
    uint32_t head = 0;
    uint8_t data[8] = {0};
    if (!self->open || self->listening_only || self->length != SLCAN_LINE_BYTES || self->line[0] != 't') {
        return false;
    }
    for (unsigned i = 1; i < SLCAN_LINE_BYTES; i++) {
        const int value = digit_value(self->line[i]);
        if (value < 0) {
            return false;
        }
        if (i < 5U) {
            head = head << 4 | (uint32_t)value;
        } else {
            data[(i - 5U) / 2U] = (uint8_t)((unsigned)data[(i - 5U) / 2U] << 4 | (unsigned)value);
        }
    }
    if (head != (COMMAND_ID << 4 | sizeof data)) {
        return false;
    }
    memcpy(self->data, data, sizeof data);
    self->came = true;
    return true;
}
#endif

static size_t command(slcan_t *self, char answer[SLCAN_ANSWER_BYTES]) {
    const char first = self->line[0];
    if (self->length == 0) {
        return reply(answer, "\r");
    }
    if (self->length == 2 && first == 'S' && self->line[1] >= '0' && self->line[1] <= '8') {
        return reply(answer, "\r"); /* a serial line has no CAN bit rate */
    }
    if (self->length == 1) {
        switch (first) {
        case 'C': self->open = false; return reply(answer, "\r");
        case 'O':
        case 'L':
            self->open = true;
            self->listening_only = first == 'L';
            return reply(answer, "\r");
        case 'V': return reply(answer, "V0101\r"); /* hardware and software, two digits each */
        case 'v': return reply(answer, "v0101\r");
        case 'N': return reply(answer, "NSCAL\r");
        default: break;
        }
    }
#ifdef APP_COMMAND_KEY
    if (take_command(self)) {
        return reply(answer, "z\r");
    }
#endif
    answer[0] = BEL;
    return 1;
}

size_t slcan_receive(slcan_t *self, uint8_t byte, char answer[SLCAN_ANSWER_BYTES]) {
    if (byte == LF && self->length == 0U) { /* of hosts that end a line with both */
        return 0;
    }
    if (byte == CR) {
        const size_t length = command(self, answer);
        self->length = 0;
        return length;
    }
    if (self->length < sizeof self->line) {
        self->line[self->length] = (char)byte;
    }
    if (self->length <= sizeof self->line) {
        self->length++;
    }
    return 0;
}

void slcan_encode(const selfcal_frame_t *frame, char line[SLCAN_FRAME_BYTES]) {
    static const char digit[] = "0123456789ABCDEF";
    size_t at = 0;
    line[at++] = 't';
    line[at++] = digit[frame->id >> 8 & 0x7U];
    line[at++] = digit[frame->id >> 4 & 0xFU];
    line[at++] = digit[frame->id & 0xFU];
    line[at++] = digit[sizeof frame->data];
    for (size_t i = 0; i < sizeof frame->data; i++) {
        line[at++] = digit[frame->data[i] >> 4];
        line[at++] = digit[frame->data[i] & 0xFU];
    }
    line[at] = CR;
}
