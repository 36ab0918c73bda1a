/* Noise of the tests that want some. */
#ifndef NOISE_H
#define NOISE_H

#include <stdint.h>

/* xorshift: any sequence will do, it must only be the same everywhere */
static uint32_t state;
static inline uint32_t draw(void) {
    state ^= state << 13;
    state ^= state >> 17;
    state ^= state << 5;
    return state;
}

static inline float noise(void) {
    float sum = 0.0F; /* of 12 uniforms: variance 1 */
    for (int i = 0; i < 12; i++) {
        sum += (float)draw() / 4294967296.0F;
    }
    return sum - 6.0F;
}

#endif
