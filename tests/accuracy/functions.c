/* Writes what each function of <math.h> that lib/ relies on makes of many arguments: for every function its arguments
 * and values in binary, one file. Runs on a host and, with the start-up of tests/bench/image.c, on an emulated
 * Cortex-M. The judge is tests/lib/test_math.py, which knows the order below.
 *
 * Arguments are COUNT bit patterns at even steps between two of one sign, hence evenly spread over the exponents. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#ifndef COUNT
#define COUNT 3000U
#endif
#define LENGTH(array) (sizeof(array) / sizeof((array)[0]))

static void put(const void *bytes, uint32_t count);

#ifdef __arm__
#include "image.h"

static int handle;

static int semihost(int operation, const void *argument) {
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static void open_file(void) {
    static const char name[] = "values.bin";
    const uint32_t block[3] = {(uint32_t)(uintptr_t)name, 5U /* wb */, sizeof name - 1U};
    handle = semihost(0x01 /* SYS_OPEN */, block);
}

static void put(const void *bytes, uint32_t count) {
    const uint32_t block[3] = {(uint32_t)handle, (uint32_t)(uintptr_t)bytes, count};
    if (semihost(0x05 /* SYS_WRITE */, block) != 0) {
        image_exit(1U);
    }
}
#else
#include <stdio.h>

static FILE *file;

static void open_file(void) {
    file = fopen("values.bin", "wb");
}

static void put(const void *bytes, uint32_t count) {
    (void)fwrite(bytes, 1, count, file);
}
#endif

/* A function between two arguments of one sign, in either width. */
typedef struct {
    float (*f)(float);
    float from, to;
} single_t;

typedef struct {
    double (*f)(double);
    double from, to;
} double_t_;

/* Wider than any argument in lib/: ln of 1e-38 to 1e38 for the logarithms, exponentials that neither overflow nor
 * become denormal. */
static const single_t singles[] = {
    {expf, -87.0F, -1e-9F},  {expf, 1e-9F, 88.0F},       {expm1f, -87.0F, -1e-9F}, {expm1f, 1e-9F, 88.0F},
    {logf, 1.2e-38F, 3e38F}, {log1pf, -0.9999F, -1e-9F}, {log1pf, 1e-9F, 3e38F},   {sqrtf, 1.2e-38F, 3e38F},
};
static const double_t_ doubles[] = {
    {exp, -700.0, -1e-17}, {exp, 1e-17, 700.0},         {expm1, -700.0, -1e-17}, {expm1, 1e-17, 700.0},
    {log, 1e-300, 1e300},  {log1p, -0.9999999, -1e-17}, {log1p, 1e-17, 1e300},   {sqrt, 1e-300, 1e300},
};

/* COUNT bit patterns of `size` bytes from `from` on, each with what a function makes of it. */
static void put_all(const void *from, const void *to, size_t size, void (*evaluate)(uint32_t kind, void *pair),
                    uint32_t kind) {
    static unsigned char pairs[4096];
    int64_t first = 0, last = 0; /* little-endian: a float's pattern is in the lower half */
    memcpy(&first, from, size);
    memcpy(&last, to, size);
    const int64_t step = (last - first) / (int64_t)COUNT;
    size_t at = 0;
    for (uint32_t i = 0; i < COUNT; i++) {
        const int64_t bits = first + step * (int64_t)i;
        memcpy(&pairs[at], &bits, size);
        evaluate(kind, &pairs[at]);
        at += 2U * size;
        if (at == sizeof pairs || i + 1U == COUNT) {
            put(pairs, (uint32_t)at);
            at = 0;
        }
    }
}

static void evaluate_single(uint32_t kind, void *pair) {
    float x[2];
    memcpy(x, pair, sizeof x[0]);
    x[1] = singles[kind].f(x[0]);
    memcpy(pair, x, sizeof x);
}

static void evaluate_double(uint32_t kind, void *pair) {
    double x[2];
    memcpy(x, pair, sizeof x[0]);
    x[1] = doubles[kind].f(x[0]);
    memcpy(pair, x, sizeof x);
}

int main(void) {
    open_file();
    for (uint32_t k = 0; k < LENGTH(singles); k++) {
        put_all(&singles[k].from, &singles[k].to, sizeof(float), evaluate_single, k);
    }
    for (uint32_t k = 0; k < LENGTH(doubles); k++) {
        put_all(&doubles[k].from, &doubles[k].to, sizeof(double), evaluate_double, k);
    }
    return 0;
}
