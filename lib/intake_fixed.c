/* A block's sums in integers, for parts without an FPU: in software floating point a sample's two
 * cost 600 instructions.
 *
 * INPUT SCALING  By each block's first sample: a step of 2^exponent unit makes it 2^25 to 2^26 steps, so that it and
 *   every sample of a quarter of its size or more are exact and others are rounded to a step, 2^-25 of the first. A
 *   sample of ROOM steps or more makes the step so much coarser that it is half of ROOM to ROOM.
 * HEAD-ROOM  |first| <= 2^26 steps, any sample less than ROOM = 2^29, their differences < 9/8 ROOM, a block less than
 *   2^32 samples: |sum| < 9/8 2^61. Squares are of differences rounded to 2^shift steps, of which they are 2^15 at
 *   most: sum_sq <= 2^62. Nothing saturates. (tests/lib/fixed/test_intake_fixed.c drives each there.)
 * GUARD BITS  The mean is off by a step at most, 2^-28 of the block's largest sample, whose own last place is 2^-24 of
 *   it. A square's root is off by 2^-15 of the largest difference at most: the mean square by 2^-14 of the largest
 *   times the rms difference.
 *
 * >> of a negative number must be arithmetic, as in bank_kernel_fixed.c. */
#include "bank_inside.h"

#ifdef SELFCAL_FIXED

#define FIRST_BITS 26
#define ROOM_BITS 29
#define ROOM (1 << ROOM_BITS)
#define PART_MAX (1 << 15)

/* The exponent with which a value has `bits` bits: 2^(bits - 1) <= |value| 2^-exponent < 2^bits. */
static int step_exponent(float value, int bits) {
    const int exponent = (int)((float_bits(value) >> 23) & 0xFFU);
    return (exponent > 0 ? exponent : 1) - 126 - bits;
}

/* value / 2^shift to nearest, |value| <= 2^30. */
static inline int32_t rounded(int32_t value, uint32_t shift) {
    return (value + (1 << shift >> 1)) >> shift;
}

/* Makes the step so coarse that `value` fits; what falls off the sums is less than a step each. */
COLD static void coarsen(selfcal_block_t *sums, float value) {
    const int exponent = step_exponent(value, ROOM_BITS), bits = exponent - sums->exponent;
    SELFCAL_ASSERT(bits > 0);
    sums->exponent = (int16_t)exponent;
    sums->first = bits < ROOM_BITS ? rounded(sums->first, (uint32_t)bits) : 0;
    sums->sum >>= bits < 63 ? bits : 63;
    const int less = bits - sums->shift;
    sums->shift = (uint8_t)(less < 0 ? -less : 0);
    if (less > 0) {
        sums->sum_sq >>= less < 31 ? 2 * less : 63;
    }
}

static inline bool fits(int32_t part) {
    return part <= PART_MAX && part >= -PART_MAX;
}

/* Makes the squares' step so coarse that `from_first` fits. */
COLD static void widen(selfcal_block_t *sums, int32_t from_first) {
    while (!fits(rounded(from_first, sums->shift))) {
        sums->shift++;
        sums->sum_sq >>= 2;
    }
}

static void open_sums(selfcal_block_t *sums, float value) {
    sums->exponent = (int16_t)step_exponent(value, FIRST_BITS);
    sums->first = to_fixed(value, -sums->exponent);
}

static void add_to(selfcal_block_t *sums, float value) {
    int32_t steps = to_fixed(value, -sums->exponent);
    if (steps >= ROOM || steps <= -ROOM) {
        coarsen(sums, value);
        steps = to_fixed(value, -sums->exponent);
    }
    const int32_t from_first = steps - sums->first;
    if (!fits(rounded(from_first, sums->shift))) {
        widen(sums, from_first);
    }
    const int32_t part = rounded(from_first, sums->shift);
    const int32_t square = part * part;
    sums->sum += from_first;
    sums->sum_sq += square;
}

void selfcal_intake_start(selfcal_t *self) {
    memset(self->sums, 0, sizeof self->sums);
}

void selfcal_intake_add(selfcal_t *self, const float sample[], uint32_t live) {
    selfcal_block_t *sums = self->sums;
    for (; live != 0U; live >>= 1, sums++, sample++) {
        if ((live & 1U) != 0U && self->used == 0U) {
            open_sums(sums, *sample);
        } else if ((live & 1U) != 0U) {
            add_to(sums, *sample);
        }
    }
}

selfcal_real_t selfcal_intake_level(const selfcal_t *self, uint8_t axis, selfcal_wide_t *scatter) {
    const selfcal_block_t *sums = &self->sums[axis];
    const selfcal_real_t from_origin = ldexpf((selfcal_real_t)sums->first, sums->exponent) - self->origin[axis];
    *scatter = 0.0;
    if (sums->sum_sq == 0) {
        return from_origin; /* one sample, or equal ones */
    }
    const selfcal_real_t sum = (selfcal_real_t)sums->sum, mean = sum / (selfcal_real_t)self->used;
    const selfcal_real_t squares = ldexpf((selfcal_real_t)sums->sum_sq, 2 * sums->shift);
    *scatter = ldexp((selfcal_wide_t)r_fmax(squares - sum * mean, R(0.0)), 2 * sums->exponent);
    return from_origin + ldexpf(mean, sums->exponent);
}

bool selfcal_intake_sound(const selfcal_t *self, uint8_t axis) {
    const selfcal_block_t *sums = &self->sums[axis];
    const int64_t most = (int64_t)self->used << 30;
    return sums->sum_sq >= 0 && sums->sum_sq <= most && sums->sum <= most && sums->sum >= -most &&
           sums->first <= 1L << 26 && sums->first >= -(1L << 26) && sums->shift <= 15U && sums->exponent >= -151 &&
           sums->exponent <= 100;
}

#else
typedef int selfcal_no_fixed_intake_t; /* C99 wants a declaration in every file */
#endif
