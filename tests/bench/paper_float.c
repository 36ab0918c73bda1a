#include "paper_float.h"

#include <math.h>

static void step(paper_filter_t *f, float y) {
    f->x *= f->phi;
    f->p_xx = f->phi * f->phi * f->p_xx + f->q;
    f->p_x0 *= f->phi;
    const float nu = y - (f->x + f->x0);
    const float h_x = f->p_xx + f->p_x0;
    const float h_0 = f->p_x0 + f->p_00;
    const float s = h_x + h_0 + f->r;
    const float k_x = h_x / s;
    const float k_0 = h_0 / s;
    f->x += k_x * nu;
    f->x0 += k_0 * nu;
    f->p_xx -= k_x * h_x;
    f->p_x0 -= k_x * h_0;
    f->p_00 -= k_0 * h_0;
    f->ln_weight -= 0.5F * (logf(s) + nu * nu / s);
}

void paper_sample(paper_filter_t filter[], size_t filters, float y) {
    float highest = -INFINITY;
    for (size_t j = 0; j < filters; j++) {
        step(&filter[j], y);
        if (filter[j].ln_weight > highest) { /* not fmaxf(): a call */
            highest = filter[j].ln_weight;
        }
    }
    float sum = 0.0F;
    for (size_t j = 0; j < filters; j++) {
        sum += expf(filter[j].ln_weight - highest);
    }
    const float ln_sum = highest + logf(sum);
    for (size_t j = 0; j < filters; j++) {
        filter[j].ln_weight -= ln_sum;
    }
}
