/* The recursion as printed in Stepanov & Motorin, IFAC-PapersOnLine 50-1 (2017) 2830-2835, in plain float C: what the
 * library's instruction counts are measured against. One textbook filter with the state (drift, bias) per (node,
 * sigma_v), its covariance at every step, and weights (11) normalised at every sample (in logarithms: as numbers they
 * would underflow). */
#ifndef PAPER_FLOAT_H
#define PAPER_FLOAT_H

#include <stddef.h>

typedef struct {
    float phi, q, r;        /* transition, drift variance per interval, white-noise variance: unit^2 */
    float x, x0;            /* drift and bias, unit */
    float p_xx, p_x0, p_00; /* their covariance */
    float ln_weight;        /* normalised */
} paper_filter_t;

/* Every filter over one sample `y` (unit), then all weights. */
void paper_sample(paper_filter_t filter[], size_t filters, float y);

#endif
