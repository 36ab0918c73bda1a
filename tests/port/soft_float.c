/* Runs one operation of port/cortex-m0/soft_float.c over arrays, for tests/port/test_soft_float.py. */
#include <stdint.h>

enum { MUL, ADD, SUB, DIV, LESS, GREATER, NOT_GREATER, NOT_LESS, EQUAL };

void run(int what, const float *a, const float *b, float *out, uint32_t count);
void run(int what, const float *a, const float *b, float *out, uint32_t count) {
    for (uint32_t i = 0; i < count; i++) {
        switch (what) {
        case MUL: out[i] = a[i] * b[i]; break;
        case ADD: out[i] = a[i] + b[i]; break;
        case SUB: out[i] = a[i] - b[i]; break;
        case DIV: out[i] = a[i] / b[i]; break;
        case LESS: out[i] = a[i] < b[i] ? 1.0F : 0.0F; break;
        case GREATER: out[i] = a[i] > b[i] ? 1.0F : 0.0F; break;
        case NOT_GREATER: out[i] = a[i] <= b[i] ? 1.0F : 0.0F; break;
        case NOT_LESS: out[i] = a[i] >= b[i] ? 1.0F : 0.0F; break;
        default: out[i] = a[i] == b[i] ? 1.0F : 0.0F;
        }
    }
}
