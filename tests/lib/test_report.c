/* The report (lib/report.c), all stages in a row: evidence, probabilities and the bias of laws without drift, whose
 * integrals are closed. */
#include "one_axis.h"

enum { SAMPLES = 300 };

static selfcal_axis_t axis;
static selfcal_hypothesis_t laws[3];
static selfcal_work_t work;
static selfcal_report_t report;
static double mean, scatter; /* of the record; the sum of squares about the mean */

void setUp(void) {
    choose(CONSTANT_LAW);
    axis = model.axis[0];
    model.axis = &axis;
}

void tearDown(void) {}

static void record(void) {
    double sum = 0.0, square = 0.0;
    begin();
    for (unsigned i = 0; i < SAMPLES; i++) {
        const float sample = 0.3F + 0.04F * noise();
        push(sample);
        sum += (double)sample;
        square += (double)sample * (double)sample;
    }
    mean = sum / SAMPLES;
    scatter = square - sum * mean;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, 0, &report));
}

/* Normal samples, bias and ln sigma_v flat (the priors are so wide that neither end counts, 1e-6 of it):
 *   p = (2 pi)^(-(n-1)/2) n^(-1/2) N(mean; 0, P0) Gamma((n-1)/2) (S/2)^(-(n-1)/2) / 2 / (ln max - ln min).
 * (P0 alone in N: the sd of the mean is 2e-4 of it.) */
static double ln_evidence(double ln_range) {
    const double n = SAMPLES, p0 = (double)axis.bias_sd * (double)axis.bias_sd, two_pi = 6.283185307179586;
    return -0.5 * (n - 1.0) * log(two_pi) - 0.5 * log(n) - 0.5 * (log(two_pi * p0) + mean * mean / p0) +
           lgamma(0.5 * (n - 1.0)) - 0.5 * (n - 1.0) * log(0.5 * scatter) - log(2.0 * ln_range);
}

/* Float sums of 300 squares: 300/2 nats times 1e-6. */
static void the_evidence_is_the_integral(void) {
    const selfcal_prior_t *prior = &axis.prior[SELFCAL_N];
    record();
    const double want = ln_evidence((double)prior->ln_max - (double)prior->ln_min);
    TEST_ASSERT_TRUE(fabs(report.hypothesis[0].ln_evidence - want) < 5e-3);
}

/* The same law three times: probabilities are the priors', and where one has half the prior range of N, twice the
 * density. */
static void probabilities_are_prior_times_evidence(void) {
    const float prior[3] = {0.5F, 0.3F, 0.2F};
    selfcal_prior_t narrow[SELFCAL_PARAMETERS];
    memcpy(narrow, axis.prior, sizeof narrow);
    const float middle = logf(0.04F), range = axis.prior[SELFCAL_N].ln_max - axis.prior[SELFCAL_N].ln_min;
    narrow[SELFCAL_N].ln_min = middle - 0.25F * range;
    narrow[SELFCAL_N].ln_max = middle + 0.25F * range;
    for (unsigned h = 0; h < 3U; h++) {
        laws[h] = hypothesis;
        laws[h].ln_probability = logf(prior[h]);
    }
    laws[2].prior = narrow;
    model.hypothesis = laws;
    model.nodes = model.hypotheses = 3;
    record();
    TEST_ASSERT_FLOAT_WITHIN(1e-4F, 0.5F / 1.2F, report.hypothesis[0].probability);
    TEST_ASSERT_FLOAT_WITHIN(1e-4F, 0.3F / 1.2F, report.hypothesis[1].probability);
    TEST_ASSERT_FLOAT_WITHIN(1e-4F, 0.4F / 1.2F, report.hypothesis[2].probability);
    TEST_ASSERT_EQUAL_FLOAT(report.hypothesis[0].bias_mean, report.bias_mean);
    TEST_ASSERT_EQUAL_FLOAT(report.hypothesis[0].bias_sd, report.bias_sd);
}

/* Of a law whose priors allow a quarter of the noise at most, the likelihood is e^-1500 of the other's: 300 times
 * ln 4 and half of 1 - 4^2. */
static void a_law_that_its_priors_exclude(void) {
    selfcal_prior_t quiet[SELFCAL_PARAMETERS];
    memcpy(quiet, axis.prior, sizeof quiet);
    quiet[SELFCAL_N].ln_max = logf(0.01F);
    laws[0] = laws[1] = hypothesis;
    laws[0].prior = quiet;
    model.hypothesis = laws;
    model.nodes = model.hypotheses = 2;
    record();
    TEST_ASSERT_TRUE(report.hypothesis[0].probability == 0.0F);
    TEST_ASSERT_EQUAL_FLOAT(1.0F, report.hypothesis[1].probability);
    TEST_ASSERT_EQUAL(SAMPLES, report.n);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(the_evidence_is_the_integral);
    RUN_TEST(probabilities_are_prior_times_evidence);
    RUN_TEST(a_law_that_its_priors_exclude);
    return UNITY_END();
}
