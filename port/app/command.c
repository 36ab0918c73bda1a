#include "command.h"

static uint64_t rotate(uint64_t x, unsigned by) {
    return x << by | x >> (64U - by);
}

static void rounds(uint64_t v[4], int count) {
    for (int i = 0; i < count; i++) {
        v[0] += v[1];
        v[1] = rotate(v[1], 13) ^ v[0];
        v[0] = rotate(v[0], 32);
        v[2] += v[3];
        v[3] = rotate(v[3], 16) ^ v[2];
        v[0] += v[3];
        v[3] = rotate(v[3], 21) ^ v[0];
        v[2] += v[1];
        v[1] = rotate(v[1], 17) ^ v[2];
        v[2] = rotate(v[2], 32);
    }
}

uint64_t command_siphash(const uint64_t key[2], uint64_t message) {
    const uint64_t word[2] = {message, 8ULL << 56}; /* the last word: no bytes are left, and the length */
    uint64_t v[4] = {key[0] ^ 0x736F6D6570736575ULL, key[1] ^ 0x646F72616E646F6DULL, key[0] ^ 0x6C7967656E657261ULL,
                     key[1] ^ 0x7465646279746573ULL};
    for (int i = 0; i < 2; i++) {
        v[3] ^= word[i];
        rounds(v, 2);
        v[0] ^= word[i];
    }
    v[2] ^= 0xFFU;
    rounds(v, 4);
    return v[0] ^ v[1] ^ v[2] ^ v[3];
}

static void pause(command_t *self, uint32_t now_ms) {
    self->paused = true;
    self->paused_ms = now_ms;
}

static bool stands(const command_t *self, uint32_t now_ms) {
    return self->open && now_ms - self->opened_ms <= COMMAND_CHALLENGE_MS;
}

void command_pass(command_t *self, uint32_t now_ms) {
    self->open = stands(self, now_ms);
    self->paused = self->paused && now_ms - self->paused_ms < COMMAND_PAUSE_MS;
}

bool command_open(command_t *self, uint32_t number, uint32_t now_ms) {
    command_pass(self, now_ms);
    if (self->open) {
        return true;
    }
    if (self->paused) {
        return false;
    }
    self->open = true;
    self->challenge = number;
    self->opened_ms = now_ms;
    pause(self, now_ms);
    return true;
}

static uint32_t little32(const uint8_t bytes[4]) {
    return (uint32_t)bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

uint8_t command_check(command_t *self, const uint64_t key[2], const uint8_t data[8], uint32_t now_ms) {
    const bool stood = stands(self, now_ms);
    self->open = false;
    if (!stood) {
        return SELFCAL_ANSWER_RESULT_NO_CHALLENGE;
    }
    const uint64_t said = (uint64_t)self->challenge | (uint64_t)little32(data) << 32;
    if ((uint32_t)command_siphash(key, said) != little32(data + 4)) {
        pause(self, now_ms);
        return SELFCAL_ANSWER_RESULT_WRONG_TAG;
    }
    return SELFCAL_ANSWER_RESULT_DONE;
}
