/* The cells of the report's integral (lib/report_integral.c) against integrands in closed form. */
#include "../../lib/report_integral.c"
#include "unity.h"

static const selfcal_prior_t x_prior = {-1.37F, 2.21F, SELFCAL_LOG_UNIFORM, false},
                             y_prior = {0.43F, 9.0F, SELFCAL_LOG_UNIFORM, false};

void setUp(void) {}

void tearDown(void) {}

/* sum over cells of height h(x, y) times the part that the limits leave, by the midpoint of that part. */
static double integral(double (*height)(double, double), double width) {
    double sum = 0.0;
    for (double x = -6.0; x < 6.0; x += width) {
        selfcal_real_t x_middle = (selfcal_real_t)(x + 0.5 * width);
        const double x_part = (double)permitted(&x_prior, &x_middle, (selfcal_real_t)width);
        for (double y = -6.0; y < 6.0 && x_part > 0.0; y += width) {
            selfcal_real_t y_middle = (selfcal_real_t)(y + 0.5 * width);
            const double part = x_part * (double)permitted(&y_prior, &y_middle, (selfcal_real_t)width);
            sum += part > 0.0 ? part * width * width * height((double)x_middle, (double)y_middle) : 0.0;
        }
    }
    return sum;
}

static double flat(double x, double y) {
    (void)x;
    (void)y;
    return 1.0;
}

static double gauss(double x, double y) {
    return exp(-0.5 * (x * x + y * y)) / 6.283185307179586;
}

static double ridge(double x, double y) { /* x = y, 0.3 wide across, 1 along */
    const double along = 0.70710678 * (x + y), across = 0.70710678 * (x - y) / 0.3;
    return exp(-0.5 * (along * along + across * across)) / (6.283185307179586 * 0.3);
}

/* P(z < x) of a normal. */
static double below(double x) {
    return 0.5 * erfc(-0.70710678118654752 * x);
}

/* A corner that the limits cut: its area whatever the cell, to float's rounding of the limits. */
static void a_flat_corner_is_exact(void) {
    const double area = (2.21 + 1.37) * (6.0 - 0.43);
    TEST_ASSERT_TRUE(fabs(integral(flat, 0.75) - area) < 1e-4);
    TEST_ASSERT_TRUE(fabs(integral(flat, 0.25) - area) < 1e-4);
}

/* A separable Gaussian cut by both limits. The midpoint rule errs by h^2/24 times the step of the slope at a limit:
 * below 2e-3 at h = 0.25. */
static void a_cut_gaussian(void) {
    const double exact = (below(2.21) - below(-1.37)) * (1.0 - below(0.43));
    TEST_ASSERT_TRUE(fabs(integral(gauss, 0.25) - exact) < 2e-3);
    TEST_ASSERT_TRUE(fabs(integral(gauss, 0.05) - exact) < 1e-4);
}

/* A ridge across the cells: coarse cells against cells so fine that nothing is left of the error. */
static void a_cut_ridge(void) {
    const double exact = integral(ridge, 0.005);
    TEST_ASSERT_TRUE(fabs(integral(ridge, 0.125) - exact) < 2e-3 * exact);
}

/* A cell inside counts whole and stays where it is; beyond the limits nothing is left. */
static void a_cell_inside_and_one_outside(void) {
    selfcal_real_t middle = R(0.0);
    TEST_ASSERT_EQUAL_FLOAT(1.0F, (float)permitted(&x_prior, &middle, R(0.5)));
    TEST_ASSERT_EQUAL_FLOAT(0.0F, (float)middle);
    middle = R(3.0);
    TEST_ASSERT_EQUAL_FLOAT(0.0F, (float)permitted(&x_prior, &middle, R(0.5)));
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(a_flat_corner_is_exact);
    RUN_TEST(a_cut_gaussian);
    RUN_TEST(a_cut_ridge);
    RUN_TEST(a_cell_inside_and_one_outside);
    return UNITY_END();
}
