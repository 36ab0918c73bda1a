/* The least squares of the report's spectrum (lib/report_spectrum.c) on a synthetic spectrum of known lines. */
#include "../../lib/report_spectrum.c"
#include "unity.h"

enum { LINES = 4, ROWS = 60 };

static selfcal_fit_t fit;

/* A weak prior on every power, as set_lines() begins: its weight is a millionth of the rows'. */
void setUp(void) {
    memset(&fit, 0, sizeof fit);
    selfcal_real_t *diagonal = fit.triangle;
    for (unsigned m = 0; m < LINES; m++) {
        *diagonal = R(1e-6);
        diagonal += LINES + 1U - m;
    }
}

void tearDown(void) {}

/* A node of pole distance p sees a line at distance d through p^2 / (p^2 + d): the shape that add_row() has. */
static selfcal_real_t seen(unsigned row, unsigned line) {
    const selfcal_real_t p = r_exp(R(-3.0) + R(0.1) * (selfcal_real_t)row);
    const selfcal_real_t d = r_exp(R(-5.0) + R(2.0) * (selfcal_real_t)line);
    return p * p / (p * p + d);
}

/* The powers come back, whatever the order of the rows. Float's rounding times the condition of four such shapes, some
 * hundred: 1e-4. */
static void the_powers_of_the_lines_come_back(void) {
    static const selfcal_real_t power[LINES] = {R(0.5), R(-1.0), R(2.0), R(0.25)};
    for (unsigned i = 0; i < ROWS; i++) {
        const unsigned at = i * 37U % ROWS;
        selfcal_real_t row[SELFCAL_FITTED + 1] = {R(0.0)};
        for (unsigned m = 0; m < LINES; m++) {
            row[m] = seen(at, m);
            row[LINES] += row[m] * power[m];
        }
        rotate_in(&fit, LINES, row);
    }
    selfcal_real_t found[LINES];
    const selfcal_real_t *end = fit.triangle;
    for (unsigned m = 0; m < LINES; m++) {
        end += LINES + 1U - m;
    }
    for (unsigned m = LINES; m-- > 0U;) { /* its diagonal, what follows in the row, the right side */
        end -= LINES + 1U - m;
        TEST_ASSERT_TRUE(end[0] > R(0.0));
        found[m] = end[LINES - m];
        for (unsigned k = m + 1U; k < LINES; k++) {
            found[m] -= end[k - m] * found[k];
        }
    }
    for (unsigned m = 0; m < LINES; m++) {
        TEST_ASSERT_FLOAT_WITHIN(1e-4F, (float)power[m], (float)found[m]);
    }
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(the_powers_of_the_lines_come_back);
    return UNITY_END();
}
