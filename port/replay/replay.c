#include "replay.h"

#include <string.h>

enum { HEADER_BYTES = 40 };

static uint32_t little32(const unsigned char *bytes) {
    return (uint32_t)bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

static uint64_t little64(const unsigned char *bytes) {
    return little32(bytes) | (uint64_t)little32(bytes + 4) << 32;
}

const char *replay_open(replay_t *replay) {
    unsigned char header[HEADER_BYTES];
    if (!replay->read(replay->context, header, sizeof header) || memcmp(header, "SELFCAL2", 8) != 0) {
        return "not a recording for this program";
    }
    if (little32(header + 8) != SELFCAL_MODEL_AXES) {
        return "its axes are not those of the model built in";
    }
    if (little32(header + 12) != SELFCAL_MODEL_CHANNELS + PORT_SIDE) {
        return "its channels are not those of the model built in";
    }
    const uint64_t rate = little64(header + 16);
    memcpy(&replay->rate_hz, &rate, sizeof rate);
    const double ratio = (double)selfcal_model.dt_s * replay->rate_hz / (double)selfcal_model.block;
    if (!(replay->rate_hz > 0.0) || !(ratio > 1.0 - 1e-5 && ratio < 1.0 + 1e-5)) {
        return "its rate is not that of the model built in";
    }
    replay->rows = little64(header + 24);
    replay->powered = little64(header + 32);
    return NULL;
}

const char *replay_next(replay_t *replay) {
    if (replay->waiting || replay->rows == 0) {
        return NULL;
    }
    if (!replay->read(replay->context, replay->row, 4U + 4U * REPLAY_VALUES)) {
        return "the recording is shorter than it says";
    }
    replay->rows--;
    replay->passed += (uint64_t)little32(replay->row) + 1U;
    replay->time_ms = (uint32_t)(uint64_t)((double)replay->passed * 1000.0 / replay->rate_hz);
    replay->waiting = true;
    return NULL;
}

port_sample_t replay_sample(replay_t *replay, float reading[], uint32_t *missing) {
    if (!replay->waiting) {
        return replay->rows == 0 ? PORT_END : PORT_EMPTY;
    }
    replay->waiting = false;
    *missing = little32(replay->row);
    for (size_t i = 0; i < REPLAY_VALUES; i++) {
        const uint32_t bits = little32(replay->row + 4 + 4 * i);
        memcpy(&reading[i], &bits, sizeof bits);
    }
    return PORT_SAMPLE;
}
