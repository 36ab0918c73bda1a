/* Cells of the report (lib/report_cells.c): likelihood and parameters between the nodes, and what limits leave of
 * sigma_v, of a likelihood in closed form. */
#include "known_posterior.h"

static const known_t known = {-1.5, 0.35, -4.5, 0.5, 0.6, -2.5};
#define DT 4.0F

void setUp(void) {
    known_priors(-8.0, 2.0, -9.0, 2.0, -8.0, -1.0);
    model.dt_s = DT;
    known_values(&known, 400);
    known_run(SEARCH);
}

void tearDown(void) {}

/* A quintic spline has a quadratic at every place. Splines of node values of up to 600 nats, in float: 2e-3. */
static void the_spline_has_the_quadratic_between_the_nodes(void) {
    for (int i = -8; i <= 8; i++) {
        const double ln_alpha = known.alpha + 0.13 * (double)i;
        selfcal_cells_row(&work, (selfcal_real_t)ln_alpha, &work.scratch.grid.row);
        for (int k = -8; k <= 8; k++) {
            const double ln_rho = known.rho + 0.11 * (double)k;
            cell_t cell;
            selfcal_cells_make(&work, (selfcal_real_t)ln_rho, &cell);
            const double want = known_height(&known, ln_rho, ln_alpha);
            TEST_ASSERT_FLOAT_WITHIN(2e-3F, (float)want, (float)(cell.profile + work.peak));
            TEST_ASSERT_FLOAT_WITHIN(1e-5F, (float)known.ln_sigma, (float)cell.ln_sigma);
            TEST_ASSERT_FALSE(cell.off_grid);
        }
    }
}

/* N = sigma_v sqrt(dt), sigma_m = rho sigma_v. */
static void parameters_of_a_cell(void) {
    selfcal_real_t ln_value[SELFCAL_PARAMETERS];
    cell_t cell;
    selfcal_cells_row(&work, (selfcal_real_t)known.alpha, &work.scratch.grid.row);
    selfcal_cells_make(&work, (selfcal_real_t)known.rho, &cell);
    selfcal_cells_parameters(&work, &cell, ln_value);
    TEST_ASSERT_FLOAT_WITHIN(1e-5F, (float)known.ln_sigma + 0.5F * logf(DT), (float)ln_value[SELFCAL_N]);
    TEST_ASSERT_FLOAT_WITHIN(1e-5F, (float)(known.ln_sigma + known.rho), (float)ln_value[SELFCAL_SIGMA_M]);
    TEST_ASSERT_EQUAL_FLOAT((float)known.alpha, (float)ln_value[SELFCAL_ALPHA]);
}

/* Beyond the outermost node nothing is known. */
static void beyond_the_nodes(void) {
    cell_t cell;
    selfcal_cells_row(&work, (selfcal_real_t)known.alpha, &work.scratch.grid.row);
    selfcal_cells_make(&work, bank.rho_lo[0] - R(0.01), &cell);
    TEST_ASSERT_TRUE(cell.off_grid);
}

/* rho is the drift over the noise: its limits are those of the priors' corners. */
static void limits(void) {
    selfcal_cells_limits(&work, &work.search);
    TEST_ASSERT_FLOAT_WITHIN(1e-5F, -9.0F - 2.0F + 0.5F * logf(DT), (float)work.search.limit_lo[0]);
    TEST_ASSERT_FLOAT_WITHIN(1e-5F, 2.0F + 8.0F + 0.5F * logf(DT), (float)work.search.limit_hi[0]);
    TEST_ASSERT_EQUAL_FLOAT(-8.0F, (float)work.search.limit_lo[1]);
    TEST_ASSERT_EQUAL_FLOAT(-1.0F, (float)work.search.limit_hi[1]);
}

/* Limits far away leave all; one above the mode by d leaves what lies below it; one below it by d lowers the peak by
 * n (-d + e^(2 d)/2 - 1/2). */
static void reach(void) {
    selfcal_real_t ln_value[SELFCAL_PARAMETERS] = {R(0.0)}, half[2] = {R(0.0), R(0.0)};
    selfcal_cells_row(&work, (selfcal_real_t)known.alpha, &work.scratch.grid.row);
    ln_value[SELFCAL_N] = R(-3.0);
    ln_value[SELFCAL_SIGMA_M] = R(-4.0);
    reach_t found = selfcal_cells_reach(&work, ln_value, half);
    TEST_ASSERT_TRUE(found.from == work.sigma.lo && found.to == work.sigma.hi && found.drop == R(0.0));
    const double d = 0.125; /* 3.5 sd of sigma_v */
    ln_value[SELFCAL_N] = (selfcal_real_t)(2.0 + d);
    found = selfcal_cells_reach(&work, ln_value, half);
    TEST_ASSERT_FLOAT_WITHIN(1e-6F, (float)-d, (float)found.peak);
    TEST_ASSERT_FLOAT_WITHIN(1e-6F, (float)-d, (float)found.to);
    const double n = (double)work.n_eff;
    TEST_ASSERT_TRUE(close_to(n * (-d + 0.5 * exp(2.0 * d) - 0.5), (double)found.drop, 1e-4));
    ln_value[SELFCAL_N] = R(3.0); /* the highest N lies e^1 below */
    ln_value[SELFCAL_SIGMA_M] = R(-9.5);
    found = selfcal_cells_reach(&work, ln_value, half);
    TEST_ASSERT_FALSE(found.from < found.to); /* the lowest sigma_m above that: nothing is left */
}

/* Three samples or more on a peak ask for 13 cells, two for what the caller says, one alone for 64. */
static void cells_for_a_peak(void) {
    selfcal_real_t height[SELFCAL_SEARCH_SAMPLES];
    for (unsigned on = 1; on <= 4U; on++) {
        for (unsigned i = 0; i < SELFCAL_SEARCH_SAMPLES; i++) {
            height[i] = i < on ? R(0.0) : R(-50.0);
        }
        TEST_ASSERT_EQUAL(on == 1U ? 64U : on == 2U ? 21U : 13U, selfcal_cells_for_peak(height, R(-3.0), 21U));
    }
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(the_spline_has_the_quadratic_between_the_nodes);
    RUN_TEST(parameters_of_a_cell);
    RUN_TEST(beyond_the_nodes);
    RUN_TEST(limits);
    RUN_TEST(reach);
    RUN_TEST(cells_for_a_peak);
    return UNITY_END();
}
