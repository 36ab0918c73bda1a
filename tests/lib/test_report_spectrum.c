/* The spectrum of a report (lib/report_spectrum.c): its own rows, least squares and solution, over nodes whose
 * innovations' variances are those of two drifts in closed form. */
#include "../../lib/report_spectrum.c"
#include "one_axis.h"

enum { SAMPLES = 3000 };

static selfcal_work_t work;

/* Two drifts of the data, variance and 1 - pole. The report supposes the first; lines are to find the second. */
static const double first[2] = {0.5, 0.02}, second[2] = {0.15, 0.1};

void setUp(void) {
    choose(MARKOV_LAW);
    begin();
    for (unsigned i = 0; i < SAMPLES; i++) {
        push(0.1F * noise());
    }
    selfcal_node_view_t view;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, 0, &view)); /* all samples are in the sums */
    memset(&work, 0, sizeof work);
    work.bank = &bank;
    work.truth.variance = (selfcal_real_t)first[0];
    work.truth.rate = (selfcal_real_t)first[1];
}

void tearDown(void) {}

/* What a drift adds to the innovations' variance of a filter (1 - phi B)/(1 - psi B): partial fractions of its
 * spectrum, as report_expected.h has them. */
static double added(const double drift[2], const expectation_t *e) {
    const double c = drift[1], beta = 1.0 - (double)e->phi, p = 1.0 - (double)e->psi;
    return drift[0] * (beta * beta * (1.0 + (1.0 - p) * (1.0 - c)) + 2.0 * (1.0 - beta) * p * c) /
           (p * (2.0 - p) * (p + c - p * c));
}

static expectation_t expected_at(uint16_t k, double aside) {
    const selfcal_place_t place = selfcal_bank_place(&bank, k);
    const selfcal_real_t ln_rho = place.ln_rho + (selfcal_real_t)aside;
    selfcal_real_t passed[SELFCAL_LINES];
    const selfcal_real_t beta = selfcal_expected_beta(&work, place.ln_alpha);
    selfcal_expected_passed(&work, beta, passed);
    expectation_t e;
    selfcal_expected(&work, ln_rho, place.ln_alpha, beta, passed, &e);
    return e;
}

/* A row for every node, as selfcal_spectrum_step() adds it. */
static void fit(void) {
    work.truth.ln_v = expected_at(0, 0.0).ln_v;
    set_lines((selfcal_real_t)bank.weight, &work.truth, &work.scratch.fit);
    for (uint16_t k = 0; k < model.nodes; k++) {
        const expectation_t e = expected_at(k, 0.0);
        const double more = added(second, &e) * (double)e.per_v; /* of the variance expected */
        add_row(&work, &e, (selfcal_real_t)(0.5 * log1p(more)), R(0.0), &work.scratch.fit);
    }
    selfcal_spectrum_solve(&work.scratch.fit, &work.truth);
}

/* ln of the innovations' variance at the nodes and halfway to the next: what the lines leave of the second drift. Lines
 * 0.45 apart in ln omega hold a continuum that each node sees over a decade: no more than float is left, 1e-6. */
static void the_lines_stand_for_a_second_drift(void) {
    double left = 0.0, before = 0.0;
    for (unsigned pass = 0; pass < 2U; pass++) {
        for (uint16_t k = 0; k < model.nodes; k++) {
            for (unsigned half = 0; half < 2U; half++) {
                const expectation_t e = expected_at(k, 0.5 * (double)half * (double)bank.rho_step[0]);
                const double p = 1.0 - (double)e.psi, n = (double)SAMPLES;
                if (p * p * n * n < 2000.0) {
                    continue; /* a filter that hardly settles within the record counts for less */
                }
                const double v = 1.0 / (double)e.per_v + added(second, &e), off = fabs((double)e.ln_v - log(v));
                if (pass == 0U) {
                    before = fmax(before, off);
                } else {
                    left = fmax(left, off);
                }
            }
        }
        if (pass == 0U) {
            fit();
        }
    }
    TEST_ASSERT_TRUE(before > 0.05);
    TEST_ASSERT_TRUE(left < 1e-5);
}

/* A record that is as supposed has no lines. */
static void nothing_beyond_the_supposed_is_fitted(void) {
    set_lines((selfcal_real_t)bank.weight, &work.truth, &work.scratch.fit);
    for (uint16_t k = 0; k < model.nodes; k++) {
        const expectation_t e = expected_at(k, 0.0);
        add_row(&work, &e, R(0.0), R(0.0), &work.scratch.fit);
    }
    selfcal_spectrum_solve(&work.scratch.fit, &work.truth);
    for (unsigned m = 0; m < unknowns(&work.truth); m++) {
        TEST_ASSERT_EQUAL_FLOAT(0.0F, (float)work.truth.power[m]);
    }
}

/* Lines are even in ln omega from 1/n to 6, which stands for pi, at most LINES_APART. */
static void lines_cover_the_records_frequencies(void) {
    set_lines((selfcal_real_t)bank.weight, &work.truth, &work.scratch.fit);
    const unsigned lines = work.truth.lines;
    TEST_ASSERT_TRUE(lines >= 8U && lines <= SELFCAL_LINES && lines % 2U == 0U);
    const double n = (double)bank.weight;
    TEST_ASSERT_FLOAT_WITHIN(1e-3F, (float)log(6.0 * n), (float)selfcal_spectrum_range((selfcal_real_t)n));
    TEST_ASSERT_FLOAT_WITHIN(1e-4F / (float)(n * n), (float)(1.0 / (n * n)), (float)work.truth.distance[0]);
    TEST_ASSERT_FLOAT_WITHIN(1e-3F, 4.0F, (float)work.truth.distance[lines - 1U]);
    TEST_ASSERT_TRUE(log(6.0 * n) / (double)(lines - 1U) <= (double)LINES_APART);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(the_lines_stand_for_a_second_drift);
    RUN_TEST(nothing_beyond_the_supposed_is_fitted);
    RUN_TEST(lines_cover_the_records_frequencies);
    return UNITY_END();
}
