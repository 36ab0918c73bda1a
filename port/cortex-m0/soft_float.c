/* Single-precision floats in software: products, sums, quotients and comparisons, which take the place of libgcc's when
 * an image is linked.
 *
 * Results are those of IEEE 754, rounded to nearest, ties to even, subnormal numbers and infinities as well. A NaN has
 * no payload. The numbers that occur run through assembly: a Cortex-M0 has 32 bits of a product, no clz, and eight
 * registers. Zeros, subnormal numbers, infinities and NaNs run through C.
 *
 * Where a comment has e and m: |x| = m 2^(e - 150), m from 2^23 to 2^24. The signed exponent is the sign above e. */
#include <stdint.h>

#define INFINITE 0x7F800000U
#define NOT_A_NUMBER 0x7FC00000U
#define SIGN 0x80000000U
#define HIDDEN 0x800000U

/* ----------------------------------------------------------------------------------------------------------- in C */

/* m 2^(e - 150 - 7) of the sign: 2^30 <= m < 2^31, its lowest bit set if anything lies below. */
static uint32_t pack(uint32_t sign, int32_t e, uint32_t m) {
    if (e <= 0) { /* subnormal: the exponent stays that of the smallest normal number */
        const uint32_t shift = e > -30 ? (uint32_t)(1 - e) : 31U;
        m = (m >> shift) | ((m & ((1U << shift) - 1U)) != 0U ? 1U : 0U);
        e = 0; /* a carry into the hidden bit makes it 1 */
    } else {
        m -= HIDDEN << 7;
    }
    const uint32_t rest = m & 0x7FU;
    const uint32_t bits = ((uint32_t)e << 23) + (m >> 7) + (rest > 0x40U || (rest == 0x40U && (m & 0x80U) != 0U));
    return sign | (e >= 255 || bits > INFINITE ? INFINITE : bits);
}

/* Exponent of a finite number but zero, and its mantissa with the hidden bit; of a subnormal one it lies below 1. */
static int32_t unpack(uint32_t bits, uint32_t *m) {
    int32_t e = (int32_t)(bits >> 23 & 0xFFU);
    *m = bits & (HIDDEN - 1U);
    if (e > 0) {
        *m |= HIDDEN;
        return e;
    }
    for (e = 1; *m < HIDDEN; e--) {
        *m <<= 1;
    }
    return e;
}

uint32_t soft_float_mul(uint32_t a, uint32_t b);
uint32_t soft_float_mul(uint32_t a, uint32_t b) {
    const uint32_t sign = (a ^ b) & SIGN, x = a & ~SIGN, y = b & ~SIGN;
    if (x > INFINITE || y > INFINITE || (x == INFINITE && y == 0U) || (x == 0U && y == INFINITE)) {
        return NOT_A_NUMBER;
    }
    if (x == INFINITE || y == INFINITE) {
        return sign | INFINITE;
    }
    if (x == 0U || y == 0U) {
        return sign;
    }
    uint32_t mx, my;
    int32_t e = unpack(x, &mx) + unpack(y, &my) - 127;
    uint64_t product = (uint64_t)mx * my; /* 2^46 to 2^48 */
    if (product >> 47 == 0U) {
        product <<= 1;
    } else {
        e++;
    }
    return pack(sign, e, (uint32_t)(product >> 17) | ((product & 0x1FFFFU) != 0U ? 1U : 0U));
}

uint32_t soft_float_div(uint32_t a, uint32_t b);
uint32_t soft_float_div(uint32_t a, uint32_t b) {
    const uint32_t sign = (a ^ b) & SIGN, x = a & ~SIGN, y = b & ~SIGN;
    if (x > INFINITE || y > INFINITE || (x == INFINITE && y == INFINITE) || (x == 0U && y == 0U)) {
        return NOT_A_NUMBER;
    }
    if (x == INFINITE || y == 0U) {
        return sign | INFINITE;
    }
    if (x == 0U || y == INFINITE) {
        return sign;
    }
    uint32_t mx, my, quotient = 0;
    int32_t e = unpack(x, &mx) - unpack(y, &my) + 127;
    if (mx < my) {
        mx <<= 1;
        e--;
    }
    for (int i = 0; i < 31; i++) { /* 1 <= mx/my < 2 */
        quotient <<= 1;
        if (mx >= my) {
            mx -= my;
            quotient |= 1U;
        }
        mx <<= 1;
    }
    return pack(sign, e, quotient | (mx != 0U ? 1U : 0U));
}

uint32_t soft_float_add(uint32_t a, uint32_t b);
uint32_t soft_float_add(uint32_t a, uint32_t b) {
    if ((a & ~SIGN) < (b & ~SIGN)) {
        const uint32_t other = a;
        a = b;
        b = other;
    }
    const uint32_t x = a & ~SIGN, y = b & ~SIGN, sign = a & SIGN;
    if (x >= INFINITE) {
        return x > INFINITE || (y == INFINITE && a != b) ? NOT_A_NUMBER : a;
    }
    if (y == 0U) {
        return x == 0U ? a & b : a;
    }
    uint32_t mx, my;
    int32_t e = unpack(x, &mx);
    const int32_t lower = e - unpack(y, &my);
    const uint32_t shift = (uint32_t)lower < 31U ? (uint32_t)lower : 31U;
    mx <<= 6; /* a bit for the carry */
    my <<= 6;
    my = (my >> shift) | ((my & ((1U << shift) - 1U)) != 0U ? 1U : 0U);
    uint32_t m = ((a ^ b) & SIGN) != 0U ? mx - my : mx + my;
    if (m == 0U) {
        return 0U;
    }
    for (e++; m < HIDDEN << 7; e--) {
        m <<= 1;
    }
    return pack(sign, e, m);
}

/* ---------------------------------------------------------------------------------------------------- in assembly */

/* FUNCTION(name): a section of its own, as -ffunction-sections makes it. */
#define FUNCTION(name)                                                                                                 \
    ".section .text." #name ",\"ax\",%progbits\n .align 2\n .global " #name "\n .thumb_func\n"                         \
    ".type " #name ",%function\n" #name ":\n"
#define END(name) ".size " #name ",.-" #name "\n"

/* The product of two mantissas of 24 bits has 48. Bits 16 to 47 come from four products of 16 and 8 bits, rounded by
 * the last of them; only where they lie half-way do the lower 16 count. */
__asm__(".syntax unified\n" FUNCTION(__aeabi_fmul) //
        "push {r4-r6, lr}\n"
        "lsrs r2, r0, #23\n" /* signed exponents */
        "lsrs r3, r1, #23\n"
        "uxtb r4, r2\n"
        "uxtb r5, r3\n"
        "adds r2, r3\n"
        "subs r4, #1\n"
        "cmp r4, #254\n"
        "bhs 8f\n" /* zero, subnormal, infinite or none */
        "subs r5, #1\n"
        "cmp r5, #254\n"
        "bhs 8f\n"
        "adds r4, r5\n"
        "subs r4, #126\n" /* e - 1 of the product */
        "cmp r4, #252\n"
        "bhi 8f\n" /* too large, or subnormal */
        "movs r4, #128\n"
        "subs r2, r4\n"
        "lsls r4, #8\n" /* the hidden bit, above the upper 16 */
        "uxtb r5, r0\n" /* m: upper 16 bits in r0 and r1, lower 8 in r5 and r6 */
        "uxtb r6, r1\n"
        "lsrs r0, #8\n"
        "lsrs r1, #8\n"
        "orrs r0, r4\n"
        "orrs r1, r4\n"
        "uxth r0, r0\n"
        "uxth r1, r1\n"
        "movs r3, r0\n"
        "muls r3, r1\n"
        "muls r0, r6\n"
        "muls r1, r5\n"
        "adds r0, r1\n"
        "muls r5, r6\n"
        "lsrs r1, r5, #8\n"
        "adds r1, r0\n"
        "lsrs r1, #8\n"
        "lsls r2, #23\n"
        "adds r1, r3\n" /* bits 16 to 47 */
        "bmi 3f\n"
        "lsls r3, r1, #26\n" /* below 2^47: 7 bits below the last */
        "beq 2f\n"
        "lsrs r1, #7\n"
        "adcs r2, r1\n"
        "movs r0, r2\n"
        "pop {r4-r6, pc}\n"
        "2: lsls r0, #8\n" /* half-way or even, unless something lies below */
        "adds r0, r5\n"
        "uxth r0, r0\n"
        "lsrs r1, #7\n"
        "bcc 5f\n"
        "b 4f\n"
        "3: lsls r3, r1, #25\n" /* 8 bits below the last, and an exponent more */
        "beq 6f\n"
        "lsrs r1, #8\n"
        "adcs r2, r1\n"
        "movs r0, #1\n"
        "lsls r0, #23\n"
        "adds r0, r2\n"
        "pop {r4-r6, pc}\n"
        "6: lsls r0, #8\n"
        "adds r0, r5\n"
        "uxth r0, r0\n"
        "movs r4, #1\n"
        "lsls r4, #23\n"
        "adds r2, r4\n"
        "lsrs r1, #8\n"
        "bcc 5f\n"
        "4: adds r2, #1\n"
        "adds r2, r1\n"
        "cmp r0, #0\n"
        "bne 7f\n"
        "lsrs r2, #1\n"
        "lsls r2, #1\n"
        "b 7f\n"
        "5: adds r2, r1\n"
        "7: movs r0, r2\n"
        "pop {r4-r6, pc}\n"
        "8: bl soft_float_mul\n"
        "pop {r4-r6, pc}\n" END(__aeabi_fmul));

/* The mantissas are left-justified: 8 bits below the last of the sum. Where the smaller one reaches below them, their
 * lowest is set if anything is cut off. */
__asm__(".syntax unified\n" FUNCTION(__aeabi_fsub) //
        "movs r2, #1\n"
        "lsls r2, #31\n"
        "eors r1, r2\n" END(__aeabi_fsub) /* runs on */
        ".global __aeabi_fadd\n .thumb_func\n .type __aeabi_fadd,%function\n"
        "__aeabi_fadd:\n"
        "push {r4-r5, lr}\n"
        "movs r2, r0\n"
        "eors r2, r1\n"
        "bmi 20f\n"
        /* of one sign */
        "cmp r0, r1\n"
        "bhs 1f\n"
        "movs r2, r0\n"
        "movs r0, r1\n"
        "movs r1, r2\n"
        "1: lsrs r3, r0, #23\n" /* signed exponent */
        "uxtb r2, r3\n"
        "cmp r2, #254\n"
        "bhs 90f\n" /* infinite, none, or the sum may be */
        "lsls r4, r1, #1\n"
        "lsrs r4, #24\n"
        "beq 80f\n" /* zero or subnormal */
        "subs r2, r4\n"
        "movs r4, #1\n"
        "lsls r4, #31\n"
        "lsls r0, #8\n"
        "lsls r1, #8\n"
        "orrs r0, r4\n"
        "orrs r1, r4\n"
        "cmp r2, #8\n"
        "bhi 10f\n"
        "lsrs r1, r2\n"
        "2: adds r0, r1\n"
        "bcs 3f\n"
        "subs r3, #1\n" /* the hidden bit adds it again */
        "lsls r3, #23\n"
        "lsls r1, r0, #25\n"
        "beq 4f\n"
        "lsrs r0, #8\n"
        "adcs r0, r3\n"
        "pop {r4-r5, pc}\n"
        "3: adds r3, #1\n" /* the carry is the hidden bit */
        "lsls r3, #23\n"
        "lsls r1, r0, #24\n"
        "beq 5f\n"
        "lsrs r0, #9\n"
        "adcs r0, r3\n"
        "pop {r4-r5, pc}\n"
        "4: lsrs r0, #8\n" /* half-way, or nothing to round */
        "bcs 6f\n"
        "adds r0, r3\n"
        "pop {r4-r5, pc}\n"
        "5: lsrs r0, #9\n"
        "bcs 6f\n"
        "adds r0, r3\n"
        "pop {r4-r5, pc}\n"
        "6: adcs r0, r3\n"
        "lsrs r0, #1\n"
        "lsls r0, #1\n"
        "pop {r4-r5, pc}\n"
        "10: bl 70f\n"
        "b 2b\n"
        /* of two signs: the greater less the smaller */
        "20: lsls r2, r0, #1\n"
        "lsls r4, r1, #1\n"
        "cmp r2, r4\n"
        "bhs 21f\n"
        "movs r3, r0\n"
        "movs r0, r1\n"
        "movs r1, r3\n"
        "movs r3, r2\n"
        "movs r2, r4\n"
        "movs r4, r3\n"
        "21: lsrs r3, r0, #23\n"
        "lsrs r2, #24\n"
        "cmp r2, #255\n"
        "beq 90f\n"
        "lsrs r4, #24\n"
        "beq 80f\n"
        "movs r5, r2\n"
        "subs r2, r4\n"
        "movs r4, #1\n"
        "lsls r4, #31\n"
        "lsls r0, #8\n"
        "lsls r1, #8\n"
        "orrs r0, r4\n"
        "orrs r1, r4\n"
        "cmp r2, #8\n"
        "bhi 30f\n"
        "lsrs r1, r2\n"
        "22: subs r0, r1\n"
        "bmi 25f\n"
        "beq 27f\n"
        "23: lsrs r1, r0, #24\n"
        "beq 26f\n"
        "24: subs r3, #1\n"
        "subs r5, #1\n"
        "lsls r0, #1\n"
        "bpl 24b\n"
        "cmp r5, #0\n"
        "ble 28f\n"
        "25: subs r3, #1\n"
        "lsls r3, #23\n"
        "lsls r1, r0, #25\n"
        "beq 4b\n"
        "lsrs r0, #8\n"
        "adcs r0, r3\n"
        "pop {r4-r5, pc}\n"
        "26: subs r3, #8\n" /* a byte at a time */
        "subs r5, #8\n"
        "lsls r0, #8\n"
        "bpl 23b\n"
        "cmp r5, #0\n"
        "bgt 25b\n"
        "28: subs r3, r5\n" /* subnormal, and exact */
        "lsrs r3, #8\n"
        "lsls r3, #31\n"
        "movs r1, #9\n"
        "subs r1, r5\n"
        "lsrs r0, r1\n"
        "orrs r0, r3\n"
        "27: pop {r4-r5, pc}\n" /* +0 */
        "30: bl 70f\n"
        "b 22b\n"
        /* r1 >> r2 for r2 > 8, its lowest bit set if anything is cut off */
        "70: cmp r2, #31\n"
        "bhi 71f\n"
        "movs r4, r1\n"
        "lsrs r1, r2\n"
        "rsbs r2, r2, #0\n"
        "adds r2, #32\n"
        "lsls r4, r2\n"
        "beq 72f\n"
        "movs r4, #1\n"
        "orrs r1, r4\n"
        "72: bx lr\n"
        "71: movs r1, #1\n"
        "bx lr\n"
        "80: lsls r4, r1, #1\n"
        "bne 90f\n"
        "lsls r4, r0, #1\n"
        "beq 90f\n"
        "pop {r4-r5, pc}\n" /* r0 + 0 */
        "90: bl soft_float_add\n"
        "pop {r4-r5, pc}\n"
        ".size __aeabi_fadd,.-__aeabi_fadd\n");

/* Quotient of two mantissas, 1 <= n/d < 2, of 25 bits, the last to round by: none lies half-way. The inverse of d comes
 * from a table of 8 bits and one step of Newton's, 13 bits and never too large; two digits of 12 bits by it may be a
 * few units too small together. */
__asm__(".syntax unified\n" FUNCTION(__aeabi_fdiv) //
        "push {r4-r6, lr}\n"
        "lsrs r2, r0, #23\n" /* signed exponents */
        "lsrs r3, r1, #23\n"
        "uxtb r4, r2\n"
        "uxtb r5, r3\n"
        "subs r2, r3\n"
        "subs r4, #1\n"
        "cmp r4, #254\n"
        "bhs 8f\n" /* zero, subnormal, infinite or none */
        "subs r5, #1\n"
        "cmp r5, #254\n"
        "bhs 8f\n"
        "subs r4, r5\n"
        "adds r4, #125\n" /* e - 1 of a quotient below 1 */
        "cmp r4, #252\n"
        "bhi 8f\n" /* too large, or subnormal */
        "adds r2, #125\n"
        "movs r4, #1\n"
        "lsls r4, #23\n"
        "lsls r0, #9\n"
        "lsls r1, #9\n"
        "lsrs r0, #9\n"
        "lsrs r1, #9\n"
        "orrs r0, r4\n"
        "orrs r1, r4\n"
        "cmp r0, r1\n"
        "bhs 1f\n"
        "lsls r0, #1\n"
        "subs r2, #1\n"
        "1: adds r2, #1\n"
        "lsrs r3, r1, #17\n"
        "ldr r4, 7f\n"
        "ldrb r3, [r4, r3]\n"
        "adds r3, #255\n"
        "adds r3, #1\n" /* 2^32/d */
        "lsrs r4, r1, #8\n"
        "adds r4, #1\n"
        "muls r4, r3\n"
        "movs r5, #1\n"
        "lsls r5, #24\n"
        "subs r5, r4\n"
        "muls r5, r3\n"
        "asrs r5, #17\n"
        "lsls r3, #7\n"
        "adds r3, r5\n" /* 2^39/d */
        "lsrs r4, r0, #9\n"
        "muls r4, r3\n"
        "lsrs r4, #18\n" /* 2^12 n/d */
        "lsls r0, #12\n"
        "movs r5, r4\n"
        "muls r5, r1\n"
        "subs r0, r5\n" /* what is left of n, below 4 d */
        "lsrs r5, r0, #10\n"
        "muls r5, r3\n"
        "lsrs r5, #17\n"
        "lsls r0, #12\n"
        "movs r6, r5\n"
        "muls r6, r1\n"
        "subs r0, r6\n"
        "lsls r4, #12\n"
        "adds r4, r5\n"
        "b 3f\n"
        "2: adds r4, #1\n"
        "subs r0, r1\n"
        "3: cmp r0, r1\n"
        "bhs 2b\n"
        "lsls r2, #23\n"
        "lsrs r0, r4, #1\n"
        "adcs r0, r2\n"
        "pop {r4-r6, pc}\n"
        "8: bl soft_float_div\n"
        "pop {r4-r6, pc}\n"
        ".align 2\n"
        "7: .word 9f - 64\n"
        "9:\n"
        ".byte 252, 244, 237, 229, 222, 215, 209, 202, 196, 190, 184, 178, 172, 167, 161, 156\n"
        ".byte 151, 146, 141, 136, 132, 127, 123, 118, 114, 110, 106, 102, 98, 94, 91, 87\n"
        ".byte 84, 80, 77, 73, 70, 67, 64, 61, 58, 55, 52, 49, 46, 43, 41, 38\n"
        ".byte 35, 33, 30, 28, 25, 23, 21, 18, 16, 14, 11, 9, 7, 5, 3, 1\n" END(__aeabi_fdiv));

/* 1 or 0; with a NaN 0. Bits compare as integers do, the other way round below zero. `of_zeros`: where two zeros go;
 * `if`, `unless`: a branch by signed integers. */
#define COMPARE(greater, less, of_zeros, if, unless)                                                                   \
    __asm__(".syntax unified\n" FUNCTION(greater) /* */                                                                \
            "movs r2, r0\n"                                                                                            \
            "movs r0, r1\n"                                                                                            \
            "movs r1, r2\n" END(greater) /* runs on */                                                                 \
            ".global " #less "\n .thumb_func\n .type " #less ",%function\n" #less ":\n"                                \
            "push {r4, lr}\n"                                                                                          \
            "movs r4, #255\n"                                                                                          \
            "lsls r4, #24\n"                                                                                           \
            "lsls r2, r0, #1\n"                                                                                        \
            "cmp r2, r4\n"                                                                                             \
            "bhi 1f\n"                                                                                                 \
            "lsls r3, r1, #1\n"                                                                                        \
            "cmp r3, r4\n"                                                                                             \
            "bhi 1f\n"                                                                                                 \
            "orrs r2, r3\n"                                                                                            \
            "beq " #of_zeros "\n"                                                                                      \
            "movs r2, r0\n"                                                                                            \
            "ands r2, r1\n"                                                                                            \
            "bmi 2f\n"                                                                                                 \
            "cmp r0, r1\n" #if " 3f\n"                                                                                 \
                               "1: movs r0, #0\n"                                                                      \
                               "pop {r4, pc}\n"                                                                        \
                               "2: cmp r1, r0\n" #unless " 1b\n"                                                       \
                               "3: movs r0, #1\n"                                                                      \
                               "pop {r4, pc}\n" END(less))
COMPARE(__aeabi_fcmpgt, __aeabi_fcmplt, 1f, blt, bge);
COMPARE(__aeabi_fcmpge, __aeabi_fcmple, 3f, ble, bgt);

__asm__(".syntax unified\n" FUNCTION(__aeabi_fcmpeq) //
        "lsls r2, r0, #1\n"
        "cmp r0, r1\n"
        "bne 1f\n"
        "movs r3, #255\n"
        "lsls r3, #24\n"
        "cmp r2, r3\n"
        "bhi 2f\n"
        "movs r0, #1\n"
        "bx lr\n"
        "1: lsls r1, #1\n"
        "orrs r1, r2\n"
        "bne 2f\n"
        "movs r0, #1\n" /* zeros of two signs */
        "bx lr\n"
        "2: movs r0, #0\n"
        "bx lr\n" END(__aeabi_fcmpeq));
