/* The functions of <math.h> that lib/ calls and that C libraries round differently, from +, -, * and / alone. Linked
 * into a host build and into an emulated one, it takes the C libraries out of the comparison: what then differs is the
 * firmware's. Right to some 1e-14, which is all it needs; SAME_FMAF adds fmaf(), which newlib does not round once where
 * the core has no instruction for it. */
#include <math.h>
#include <stdint.h>
#include <string.h>

/* fdlibm's split of ln 2 */
static const double LN2_HIGH = 0.693147180369123816490, LN2_LOW = 1.90821492927058770002e-10;

static double scaled(double value, int exponent) {
    for (; exponent > 1000; exponent -= 1000) {
        value *= 0x1p1000;
    }
    for (; exponent < -1000; exponent += 1000) {
        value *= 0x1p-1000;
    }
    const uint64_t bits = (uint64_t)(exponent + 1023) << 52;
    double power;
    memcpy(&power, &bits, sizeof power);
    return value * power;
}

/* e^r - 1 for |r| < 0.35 */
static double expm1_small(double r) {
    double sum = 0.0;
    for (int n = 16; n >= 1; n--) {
        sum = (sum + 1.0) * r / n;
    }
    return sum;
}

double exp(double x) {
    if (x != x) {
        return x;
    }
    if (x > 710.0) {
        return (double)INFINITY;
    }
    if (x < -746.0) {
        return 0.0;
    }
    const int k = (int)(x / 0.69314718055994530942 + (x < 0.0 ? -0.5 : 0.5));
    return scaled(1.0 + expm1_small(x - k * LN2_HIGH - k * LN2_LOW), k);
}

double expm1(double x) {
    return x > -0.3 && x < 0.3 ? expm1_small(x) : exp(x) - 1.0;
}

double log(double x) {
    if (!(x > 0.0)) {
        return x == 0.0 ? (double)-INFINITY : (double)NAN;
    }
    if (x > 1.7976931348623157e308) {
        return x;
    }
    int k = 0;
    for (; x < 0x1p-1000; x *= 0x1p54) { /* subnormal numbers too */
        k -= 54;
    }
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    k += (int)(bits >> 52) - 1023;
    bits = (bits & 0xFFFFFFFFFFFFFU) | (uint64_t)1023 << 52;
    double m;
    memcpy(&m, &bits, sizeof m);
    if (m > 1.41421356237309504880) {
        m *= 0.5;
        k++;
    }
    const double z = (m - 1.0) / (m + 1.0), z2 = z * z; /* ln m = 2 artanh z, |z| < 0.172 */
    double sum = 0.0;
    for (int n = 25; n >= 1; n -= 2) {
        sum = sum * z2 + 1.0 / n;
    }
    return k * LN2_HIGH + (k * LN2_LOW + 2.0 * z * sum);
}

double log1p(double x) {
    const double u = 1.0 + x;
    return u == 1.0 ? x : u > 1e300 || !(u > 0.0) ? log(u) : log(u) * (x / (u - 1.0));
}

float expf(float x) {
    return (float)exp((double)x);
}

float expm1f(float x) {
    return (float)expm1((double)x);
}

float logf(float x) {
    return (float)log((double)x);
}

float log1pf(float x) {
    return (float)log1p((double)x);
}

#ifdef SAME_FMAF
float fmaf(float x, float y, float z) {
    return (float)((double)x * (double)y + (double)z);
}
#endif
