#include "slcan.h"

#include <string.h>

#define CR '\r'
#define BEL '\a'

void slcan_init(slcan_t *self)
{
    memset(self, 0, sizeof *self);
}

static size_t reply(char answer[SLCAN_ANSWER_BYTES], const char *text)
{
    size_t length = 0;
    for (; text[length] != '\0'; length++) {
        answer[length] = text[length];
    }
    return length;
}

static size_t command(slcan_t *self, char answer[SLCAN_ANSWER_BYTES])
{
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
        case 'L': self->open = true; return reply(answer, "\r");
        case 'V': return reply(answer, "V0101\r"); /* hardware and software, two digits each */
        case 'v': return reply(answer, "v0101\r");
        case 'N': return reply(answer, "NSCAL\r");
        default: break;
        }
    }
    answer[0] = BEL;
    return 1;
}

size_t slcan_receive(slcan_t *self, uint8_t byte, char answer[SLCAN_ANSWER_BYTES])
{
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

void slcan_encode(const selfcal_frame_t *frame, char line[SLCAN_FRAME_BYTES])
{
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
