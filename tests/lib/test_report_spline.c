/* The splines of the report (lib/report_spline.c) against identities of B-splines. */
#include "../../lib/report_spline.c"
#include "unity.h"

void setUp(void) {}

void tearDown(void) {}

/* Partition of unity, and sum xi_i B_i(z) = z with the Greville abscissae xi_i, the mean of the five knots inside
 * (Marsden 1970). A float's rounding over 15 products: 1e-5 of the range. */
static void one_and_z_are_reproduced(void) {
    for (uint16_t nodes = 6; nodes <= 24; nodes++) {
        for (int step = 0; step <= 200; step++) {
            const selfcal_real_t z = (selfcal_real_t)(nodes - 1U) * (selfcal_real_t)step / R(200.0);
            selfcal_real_t basis[6], one = R(0.0), mean = R(0.0);
            const int first = selfcal_spline_basis(nodes, z, basis);
            for (int i = 0; i < 6; i++) {
                int sum = 0;
                for (int k = 1; k <= 5; k++) {
                    sum += knot(nodes, first + i + k);
                }
                TEST_ASSERT_TRUE(basis[i] > R(-1e-5));
                one += basis[i];
                mean += basis[i] * (selfcal_real_t)sum / R(5.0);
            }
            TEST_ASSERT_FLOAT_WITHIN(1e-5F, 1.0F, (float)one);
            TEST_ASSERT_FLOAT_WITHIN(1e-5F * (float)nodes, (float)z, (float)mean);
        }
    }
}

/* Beyond the ends the value of the end counts. */
static void ends_hold(void) {
    selfcal_real_t inside[6], outside[6];
    TEST_ASSERT_EQUAL(selfcal_spline_basis(16, R(15.0), inside), selfcal_spline_basis(16, R(99.0), outside));
    TEST_ASSERT_EQUAL_MEMORY(inside, outside, sizeof inside);
    TEST_ASSERT_EQUAL(selfcal_spline_basis(16, R(0.0), inside), selfcal_spline_basis(16, R(-3.0), outside));
    TEST_ASSERT_EQUAL_MEMORY(inside, outside, sizeof inside);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(one_and_z_are_reproduced);
    RUN_TEST(ends_hold);
    return UNITY_END();
}
