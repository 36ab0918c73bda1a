/* The search of the report (lib/report_search.c): where a likelihood in closed form counts. */
#include "known_posterior.h"

void setUp(void) {}

void tearDown(void) {}

static const double ends[] = {-9.0, 2.0, -8.0, -1.0};

/* A cell counts down to e^-12 of its row's peak, and so does a row. Of a normal shape that is an interval in closed
 * form, about the ridge. */
static void ranges_hold_what_counts_and_little_more(const known_t *known) {
    known_priors(-8.0, 2.0, ends[0], ends[1], ends[2], ends[3]);
    known_values(known, 400);
    known_run(SUM);
    const double depth = 12.0, root = sqrt(2.0 * depth), r = known->correlation;
    const selfcal_range_t *rows = &work.search.range[1];
    const double row = ((double)rows->hi - (double)rows->lo) / (double)SELFCAL_SEARCH_SAMPLES;
    /* samples are the middles of parts: what counts ends between the last that does and the next */
    TEST_ASSERT_TRUE((double)rows->lo < known->alpha - root * known->alpha_sd + row);
    TEST_ASSERT_TRUE((double)rows->hi > known->alpha + root * known->alpha_sd - row);
    TEST_ASSERT_TRUE((double)rows->hi - (double)rows->lo < 2.0 * root * known->alpha_sd / 0.7 + 2.0 * row);
    double missed = 0.0;
    const double sd = known->rho_sd * sqrt(1.0 - r * r);
    for (unsigned i = 0; i < SELFCAL_SEARCH_SAMPLES; i++) {
        const double ln_alpha = (double)rows->lo + row * ((double)i + 0.5);
        const double ridge = known->rho + r * known->rho_sd * (ln_alpha - known->alpha) / known->alpha_sd;
        const double below = -known_height(known, ridge, ln_alpha);
        if (below > depth - 1.0) {
            continue; /* at the edge of what counts */
        }
        const double half = sqrt(2.0 * (depth - below)) * sd;
        const selfcal_range_t *found = &work.scratch.grid.found[i];
        const double part = ((double)found->hi - (double)found->lo) / (double)SELFCAL_SEARCH_SAMPLES;
        TEST_ASSERT_TRUE((double)found->lo < ridge - half + part && (double)found->hi > ridge + half - part);
        TEST_ASSERT_TRUE((double)found->hi - (double)found->lo < 2.0 * root * sd / 0.7 + 2.0 * part);
        /* of the highest sample, half a part from the ridge at most */
        const double height = (double)work.scratch.grid.height[i] + (double)work.peak, miss = part / sd;
        TEST_ASSERT_TRUE(height < 2e-3 - below && height > -2e-3 - below - 0.125 * miss * miss);
        missed = fmax(missed, miss);
    }
    const double best = (double)work.search.best + (double)work.peak, apart = row / known->alpha_sd;
    TEST_ASSERT_TRUE(best < 2e-3 && best > -2e-3 - 0.125 * (missed * missed + apart * apart));
}

static void a_round_peak(void) {
    const known_t known = {-1.5, 0.35, -4.5, 0.5, 0.0, -2.5};
    ranges_hold_what_counts_and_little_more(&known);
}

static void a_ridge(void) {
    const known_t known = {-1.5, 0.35, -4.5, 0.5, -0.95, -2.5};
    ranges_hold_what_counts_and_little_more(&known);
}

/* Narrower than the nodes are apart: the search begins with the nodes and shrinks to a twentieth. */
static void a_narrow_peak(void) {
    const known_t known = {-1.3, 0.03, -4.4, 0.04, 0.3, -2.5};
    ranges_hold_what_counts_and_little_more(&known);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(a_round_peak);
    RUN_TEST(a_ridge);
    RUN_TEST(a_narrow_peak);
    return UNITY_END();
}
