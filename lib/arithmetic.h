/* Arithmetic in selfcal_real_t, and the bits of numbers. Not for users. */
#ifndef SELFCAL_ARITHMETIC_H
#define SELFCAL_ARITHMETIC_H

#include <math.h>
#include <string.h>

#include "selfcal.h"

/* Arithmetic in selfcal_real_t. The fused multiply-add is written out, so that a host and a target round alike. */
#ifdef SELFCAL_REAL_DOUBLE
#define R(x) (x)
#define r_fma_exact fma
#define r_exp exp
#define r_expm1 expm1
#define r_log log
#define r_log1p log1p
#define r_sqrt sqrt
#define r_fabs fabs
#define r_sin sin
#define r_cos cos
#else
#define R(x) (x##F)
#define r_fma_exact fmaf
#define r_exp expf
#define r_expm1 expm1f
#define r_log logf
#define r_log1p log1pf
#define r_sqrt sqrtf
#define r_fabs fabsf
#define r_sin sinf
#define r_cos cosf
#endif

/* Written out: fminf() and fmaxf() are calls in newlib and were a third of a report. Neither argument may be NaN. */
static inline selfcal_real_t r_fmin(selfcal_real_t a, selfcal_real_t b) {
    return a < b ? a : b;
}

static inline selfcal_real_t r_fmax(selfcal_real_t a, selfcal_real_t b) {
    return a > b ? a : b;
}

/* By value, so that a compiler that fears odd addresses copies no bytes. */
static inline uint32_t float_bits(float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

/* Whether the byte is one that a bool has: to read another as a bool, from memory that was overwritten, is
 * undefined. */
static inline bool is_bool(const bool *flag) {
    uint8_t byte;
    memcpy(&byte, flag, sizeof byte);
    return byte <= 1U;
}

/* r_fma() where one rounding less is welcome, r_fma_exact() where the product's error is the point. In software a fused
 * multiply-add is ten times a product and a sum. */
#ifdef SELFCAL_FIXED
static inline selfcal_real_t r_fma(selfcal_real_t a, selfcal_real_t b, selfcal_real_t c) {
    return a * b + c;
}

/* value * 2^shift, rounded to nearest; held at +-INT32_MAX. Bit by bit: a tenth of what software floating point
 * takes. */
static inline int32_t to_fixed(float value, int shift) {
    const uint32_t bits = float_bits(value);
    const int exponent = (int)((bits >> 23) & 0xFFU);
    if (exponent == 0) {
        return 0; /* zero, or denormal */
    }
    const uint32_t mantissa = (bits & 0x7FFFFFU) | 0x800000U;
    const int left = exponent - 150 + shift; /* value = mantissa 2^(exponent - 150) */
    uint32_t magnitude = INT32_MAX;
    if (left < -24) {
        magnitude = 0;
    } else if (left < 0) {
        magnitude = (mantissa + (1U << (-left - 1))) >> -left;
    } else if (left <= 7) {
        magnitude = mantissa << left;
    }
    return (bits >> 31) != 0U ? -(int32_t)magnitude : (int32_t)magnitude;
}
#else
#define r_fma r_fma_exact
#endif

#define SELFCAL_LN_2PI 1.8378770664093454836
#define SELFCAL_LN_2 0.69314718055994530942

/* C99 has no _Static_assert. `name` says what holds. */
#define SELFCAL_STATIC_ASSERT(name, condition) typedef char selfcal_assert_##name[(condition) ? 1 : -1]

/* Kept apart from what every sample runs through, whose registers and bytes it would take. */
#ifdef __GNUC__
#define COLD __attribute__((noinline))
#else
#define COLD
#endif

#endif
