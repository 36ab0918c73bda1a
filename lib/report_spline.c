/* Spline: quintic B-splines through the nodes of a grid, in ln rho and ln alpha (not-a-knot). */
#include "report_inside.h"

#define STEP_LINES 8U /* of one step */

/* Knot k of the spline through `nodes` points one apart: six at either end, none at the two points next to them. */
static int knot(int nodes, int k) {
    return k <= 5 ? 0 : (k >= nodes ? nodes - 1 : k - 3);
}

/* By the Cox-de Boor recursion. */
uint8_t selfcal_spline_basis(uint16_t nodes, selfcal_real_t z, selfcal_real_t out[6]) {
    /* No more lies between six knots: 7 or, of 9 or 10 nodes, all. */
    static const selfcal_real_t inverse[10] = {R(0.0),          R(1.0),          R(1.0) / R(2.0), R(1.0) / R(3.0),
                                               R(1.0) / R(4.0), R(1.0) / R(5.0), R(1.0) / R(6.0), R(1.0) / R(7.0),
                                               R(1.0) / R(8.0), R(1.0) / R(9.0)};
    z = r_fmin(r_fmax(z, R(0.0)), (selfcal_real_t)(nodes - 1U));
    int span = (int)z + 3; /* unless a knot is missing there */
    span = span < 6 ? 5 : (span >= nodes - 1 ? nodes - 1 : span);
    while (span > 5 && z < (selfcal_real_t)knot(nodes, span)) {
        span--;
    }
    int at[10]; /* the knots that count, five either side */
    selfcal_real_t to[10];
    for (int k = 0; k < 10; k++) {
        at[k] = knot(nodes, span - 4 + k);
        to[k] = (selfcal_real_t)at[k] - z;
    }
    out[0] = R(1.0);
    for (int k = 1; k <= 5; k++) {
        selfcal_real_t carry = R(0.0);
        for (int i = 0; i < k; i++) {
            const selfcal_real_t part = out[i] * inverse[at[5 + i] - at[5 + i - k]];
            out[i] = r_fma(to[5 + i], part, carry);
            carry = -to[5 + i - k] * part;
        }
        out[k] = carry;
    }
    return (uint8_t)(span - 5);
}

/* One line of values, `stride` apart, by the grid's matrix or its transpose; as it is without a grid. */
static void transform_line(const selfcal_grid_t *grid, bool transposed, const selfcal_real_t in[], selfcal_real_t out[],
                           size_t stride) {
    const size_t nodes = grid_nodes(grid);
    selfcal_real_t line[SELFCAL_GRID_MAX];
    for (size_t i = 0; i < nodes; i++) {
        line[i] = in[i * stride];
    }
    for (size_t i = 0; i < nodes; i++) {
        selfcal_real_t sum = grid == NULL ? line[i] : R(0.0);
        for (size_t k = 0; grid != NULL && k < nodes; k++) {
            sum = r_fma(grid->fit[transposed ? k * nodes + i : i * nodes + k], line[k], sum);
        }
        out[i * stride] = sum;
    }
}

/* Along alpha, then along rho. */
bool selfcal_spline_step(selfcal_work_t *work, bool transposed, int which) {
    const selfcal_real_t *in = &work->field[which][work->first_node];
    selfcal_real_t *out = work->scratch.grid.spline[which];
    const selfcal_grid_t *rho = hypothesis_of(work)->rho, *alpha = hypothesis_of(work)->alpha;
    const uint16_t rows = grid_nodes(rho), columns = grid_nodes(alpha), lines = (uint16_t)(rows + columns);
    for (uint16_t i = step_part(work, STEP_LINES, lines); i < work->at; i++) {
        if (i < rows) {
            const size_t row = (size_t)i * columns;
            transform_line(alpha, transposed, &in[row], &out[row], 1);
        } else {
            transform_line(rho, transposed, &out[i - rows], &out[i - rows], columns);
        }
    }
    return work->at == lines;
}
