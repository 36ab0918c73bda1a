/* Counts the instructions of the library on a Cortex-M, prints them as count.h says, and ends with exit code 0. Every
 * run is the same. */
#include "count.h"
#include "bank_inside.h"
#include "paper_float.h"
#include "record.h"

#include <math.h>
#include <stdbool.h>

#define AXES SELFCAL_MODEL_AXES /* six: bench.py counts on it */
/* Bank samples counted at a time: whole batches, and the sums are folded once. */
#define WINDOW 64U
/* Bank samples of the record that reports are made of: an hour at 1 Hz. */
#define HOUR 3600U

static uint64_t memory[(SELFCAL_SIZE(SELFCAL_MODEL_NODES, AXES) + 7U) / 8U];
static selfcal_t bank;
static selfcal_work_t work;
static selfcal_report_t report;
static selfcal_telemetry_t telemetry;

/* --- measures --- */

static record_t record;
static selfcal_model_t model; /* record_model() */
static float window[WINDOW][AXES];

static void make_window(void) {
    for (unsigned i = 0; i < WINDOW; i++) {
        record_next(&record, window[i]);
    }
}

static void push_window(unsigned samples) {
    for (unsigned i = 0; i < samples; i++) {
        (void)selfcal_push(&bank, window[i]);
    }
}

static void init(const selfcal_model_t *which) {
    record_init(&record);
    count_require(selfcal_init(&bank, which, memory, sizeof memory) == SELFCAL_OK, "init");
}

static void measure_clock(void) {
    count_print_empty();
    image_time_t start = image_now();
    image_known_loop(1000U);
    count_print("clock.loop_1000", count_since(start), 1U);
    start = image_now();
    image_known_loop(2001000U);
    count_print("clock.loop_2001000", count_since(start), 1U);
}

/* The averager alone: one block of the default model. */
static void measure_push(void) {
    init(&selfcal_model);
    taken_t taken = {0, 0, 0};
    unsigned left = selfcal_model.block;
    while (left > 0U) {
        const unsigned samples = left < WINDOW ? left : WINDOW;
        make_window();
        const image_time_t start = image_now();
        push_window(samples);
        count_add(&taken, count_since(start));
        left -= samples;
    }
    count_require(selfcal_count(&bank) == 1U, "one block");
    count_print("push", taken, selfcal_model.block);
}

static void measure_window(const char *name) {
    make_window();
    const image_time_t start = image_now();
    push_window(WINDOW);
    count_print(name, count_since(start), (uint64_t)WINDOW * SELFCAL_MODEL_NODES * AXES);
}

/* A batch without the averager: gains, kernels and long sums, from the last sample that fills it. */
static taken_t run_one_batch(void) {
    make_window();
    selfcal_bank_flush(&bank);
    image_time_t start = image_now();
    for (unsigned i = 0; i < SELFCAL_BATCH; i++) {
        float y[AXES];
        for (unsigned axis = 0; axis < AXES; axis++) {
            y[axis] = window[i][axis] - (float)selfcal_offset(&bank, (uint8_t)axis);
        }
        if (i == SELFCAL_BATCH - 1U) {
            start = image_now();
        }
        selfcal_bank_sample(&bank, y, 1.0F);
    }
    (void)selfcal_bank_run(&bank, SELFCAL_MODEL_NODES);
    return count_since(start);
}

static void measure_kernels(void) {
    count_print("bank.steady.alone", run_one_batch(), (uint64_t)SELFCAL_BATCH * SELFCAL_MODEL_NODES * AXES);
}

/* The dearest of the next pushes. */
static void print_worst_push(const char *name, unsigned samples) {
    taken_t worst = {0, 0, 0};
    make_window();
    for (unsigned i = 0; i < samples; i++) {
        const image_time_t start = image_now();
        (void)selfcal_push(&bank, window[i]);
        const taken_t taken = count_since(start);
        worst = taken.ticks > worst.ticks ? taken : worst;
    }
    count_print(name, worst, 1U);
}

/* At 819.2 Hz averaged to 1 Hz, where the nodes have time: from the first sample over the batch that places the
 * nodes. */
static void measure_first_push(void) {
    init(&selfcal_model);
    taken_t worst = {0, 0, 0};
    make_window();
    for (unsigned i = 0; i < (SELFCAL_BATCH + 1U) * selfcal_model.block; i++) {
        const image_time_t start = image_now();
        (void)selfcal_push(&bank, window[i % WINDOW]);
        const taken_t taken = count_since(start);
        worst = taken.ticks > worst.ticks ? taken : worst;
    }
    count_print("push.worst", worst, 1U);
}

static void measure_steady(void) {
    selfcal_axis_t axis[AXES];
    const selfcal_model_t fast = record_narrow_model(true, axis);
    init(&fast);
    while (record_settled(&bank) < SELFCAL_MODEL_NODES) {
        count_require(selfcal_count(&bank) < 5000U, "every filter settles");
        make_window();
        push_window(WINDOW);
    }
    measure_window("bank.steady");
    measure_kernels();
    print_worst_push("bank.steady.worst_push", WINDOW);

    selfcal_node_view_t view;
    (void)selfcal_skip(&bank, 10U);
    const image_time_t start = image_now();
    (void)selfcal_node(&bank, 0U, 0U, &view); /* runs the gap; the view itself is small beside it */
    count_print("bank.gap", count_since(start), 1U);
}

static void measure_varying(void) {
    selfcal_axis_t axis[AXES];
    const selfcal_model_t slow = record_narrow_model(false, axis);
    init(&slow);
    print_worst_push("bank.first.worst_push", 2U * SELFCAL_BATCH);
    make_window();
    push_window(WINDOW - 2U * SELFCAL_BATCH);
    measure_window("bank.varying");
    count_require(record_settled(&bank) == 1U, "all filters but the constant one vary");
}

/* An hour at 1 Hz under the default priors. */
static void measure_hour(void) {
    init(&model);
    taken_t hour = {0, 0, 0};
    while (selfcal_count(&bank) < HOUR) {
        make_window();
        const unsigned left = HOUR - selfcal_count(&bank);
        const image_time_t start = image_now();
        push_window(left < WINDOW ? left : WINDOW);
        count_add(&hour, count_since(start));
    }
    count_print("bank.hour", hour, (uint64_t)HOUR * SELFCAL_MODEL_NODES * AXES);
    count_print_value("bank.hour.settled", record_settled(&bank));
}

static void measure_report(void) {
    /* in the order of the stages in report.c */
    static const char *const stage_name[][3] = {
        {"report.gather", "report.gather.worst_step", "report.gather.steps"},
        {"report.truth", "report.truth.worst_step", "report.truth.steps"},
        {"report.fit", "report.fit.worst_step", "report.fit.steps"},
        {"report.sigma", "report.sigma.worst_step", "report.sigma.steps"},
        {"report.values", "report.values.worst_step", "report.values.steps"},
        {"report.spline_profile", "report.spline_profile.worst_step", "report.spline_profile.steps"},
        {"report.spline_sigma", "report.spline_sigma.worst_step", "report.spline_sigma.steps"},
        {"report.search", "report.search.worst_step", "report.search.steps"},
        {"report.sum", "report.sum.worst_step", "report.sum.steps"},
        {"report.weights", "report.weights.worst_step", "report.weights.steps"},
        {"report.weights_sq", "report.weights_sq.worst_step", "report.weights_sq.steps"},
        {"report.bias", "report.bias.worst_step", "report.bias.steps"},
        {"report.estimates", "report.estimates.worst_step", "report.estimates.steps"},
        {"report.evidence", "report.evidence.worst_step", "report.evidence.steps"},
        {"report.whole", "report.whole.worst_step", "report.whole.steps"},
    };
    enum { STAGES = sizeof stage_name / sizeof stage_name[0] };
    taken_t sum[STAGES] = {{0, 0, 0}}, worst[STAGES] = {{0, 0, 0}};
    unsigned steps[STAGES] = {0};
    image_time_t start = image_now();
    count_require(selfcal_report_begin(&work, &bank, 0U, &report) == SELFCAL_OK, "report begins");
    taken_t total = count_since(start);
    selfcal_status_t status = SELFCAL_BUSY;
    while (status == SELFCAL_BUSY) {
        const unsigned stage = work.stage;
        count_require(stage < STAGES, "the stages of report.c");
        start = image_now();
        status = selfcal_report_step(&work, &report);
        const taken_t taken = count_since(start);
        steps[stage]++;
        count_add(&sum[stage], taken);
        count_add(&total, taken);
        if (taken.ticks > worst[stage].ticks) {
            worst[stage] = taken;
        }
    }
    count_require(status == SELFCAL_OK, "report ends");
    count_print("report", total, 1U);
    for (unsigned stage = 0; stage < STAGES; stage++) {
        count_print(stage_name[stage][0], sum[stage], 1U);
        count_print(stage_name[stage][1], worst[stage], 1U);
        count_print_value(stage_name[stage][2], steps[stage]);
    }
}

static void measure_telemetry(void) {
    count_require(selfcal_telemetry_init(&telemetry, &selfcal_model, selfcal_model_axis_name) == SELFCAL_OK,
                  "telemetry");
    const image_time_t start = image_now();
    (void)selfcal_telemetry_report(&telemetry, &report, selfcal_counters(&bank), HOUR * 1000U);
    unsigned frames = 0;
    selfcal_frame_t frame;
    while (selfcal_telemetry_next(&telemetry, &frame)) {
        frames++;
    }
    count_print("telemetry", count_since(start), frames);
}

#ifdef __ARM_FP

/* The paper's recursion over some nodes of the bank, times a grid of sigma_v, on one axis; then the weights of both. */
enum { PAPER_NODES = 12, PAPER_SIGMAS = 12, PAPER_FILTERS = PAPER_NODES * PAPER_SIGMAS, PAPER_SAMPLES = 1000 };

static paper_filter_t paper[PAPER_FILTERS];
static selfcal_wide_t ln_likelihood[PAPER_FILTERS];

static uint16_t paper_node(unsigned i) {
    return (uint16_t)(i * (SELFCAL_MODEL_NODES - 1U) / (PAPER_NODES - 1U));
}

/* 12 values a factor 1.01 apart about what made the record, so that several keep some weight. */
static selfcal_wide_t paper_sigma(unsigned k) {
    return 0.04 * exp(0.01 * ((selfcal_wide_t)k - 0.5 * (PAPER_SIGMAS - 1)));
}

static void paper_init(paper_filter_t *f, const selfcal_node_view_t *node, selfcal_wide_t sigma_v) {
    const selfcal_wide_t bias_sd = (selfcal_wide_t)model.axis[0].bias_sd;
    selfcal_wide_t phi = 1.0, q = 0.0, p_first = 0.0; /* before the first prediction */
    const selfcal_law_t *law = model.hypothesis[node->hypothesis].law;
    if (law->terms > 0U && law->term[0].kind == SELFCAL_WALK) {
        q = exp(2.0 * node->ln_rho);
    } else if (law->terms > 0U) {
        const selfcal_wide_t alpha_dt = exp(node->ln_alpha) * (selfcal_wide_t)model.dt_s;
        phi = exp(-alpha_dt);
        p_first = exp(2.0 * node->ln_rho);
        q = p_first * -expm1(-2.0 * alpha_dt);
    }
    const selfcal_wide_t r = sigma_v * sigma_v;
    const paper_filter_t start = {
        (float)phi, (float)(q * r), (float)r, 0.0F, 0.0F, (float)(p_first * r), 0.0F, (float)(bias_sd * bias_sd), 0.0F};
    *f = start;
}

static void measure_paper(void) {
    init(&model);
    for (unsigned i = 0; i < PAPER_SAMPLES; i++) {
        float sample[AXES];
        record_next(&record, sample);
        (void)selfcal_push(&bank, sample);
    }
    for (unsigned i = 0; i < PAPER_NODES; i++) {
        selfcal_node_view_t node;
        count_require(selfcal_node(&bank, 0U, paper_node(i), &node) == SELFCAL_OK, "node");
        for (unsigned k = 0; k < PAPER_SIGMAS; k++) {
            const unsigned j = i * PAPER_SIGMAS + k;
            paper_init(&paper[j], &node, paper_sigma(k));
            count_require(selfcal_log_likelihood(&bank, 0U, paper_node(i), paper_sigma(k), &ln_likelihood[j]) ==
                              SELFCAL_OK,
                          "likelihood");
        }
    }
    record_init(&record);
    taken_t taken = {0, 0, 0};
    for (unsigned i = 0; i < PAPER_SAMPLES; i++) {
        float sample[AXES];
        record_next(&record, sample);
        const image_time_t start = image_now();
        paper_sample(paper, PAPER_FILTERS, sample[0]);
        count_add(&taken, count_since(start));
    }
    count_print("paper", taken, (uint64_t)PAPER_SAMPLES * PAPER_FILTERS);

    selfcal_wide_t highest = (selfcal_wide_t)-INFINITY, sum = 0.0, worst = 0.0, heaviest = 0.0;
    for (unsigned j = 0; j < PAPER_FILTERS; j++) {
        highest = fmax(highest, ln_likelihood[j]);
    }
    for (unsigned j = 0; j < PAPER_FILTERS; j++) {
        sum += exp(ln_likelihood[j] - highest);
    }
    for (unsigned j = 0; j < PAPER_FILTERS; j++) {
        const selfcal_wide_t weight = exp(ln_likelihood[j] - highest) / sum;
        heaviest = fmax(heaviest, weight);
        worst = fmax(worst, fabs(weight - exp((selfcal_wide_t)paper[j].ln_weight)));
    }
    count_print_value("paper.worst_weight_difference_1e9", (uint64_t)(1e9 * worst));
    count_print_value("paper.heaviest_weight_1e9", (uint64_t)(1e9 * heaviest));
}

#endif

static void measure_sizes(void) {
    count_print_value("ram.selfcal_t", sizeof bank);
    count_print_value("ram.selfcal_work_t", sizeof work);
    count_print_value("ram.selfcal_report_t", sizeof report);
    count_print_value("ram.selfcal_telemetry_t", sizeof telemetry);
    count_print_value("ram.SELFCAL_SIZE", SELFCAL_SIZE(SELFCAL_MODEL_NODES, AXES));
    count_print_value("nodes", SELFCAL_MODEL_NODES);
    count_print_value("block", selfcal_model.block);
}

int main(void) {
    image_start_clock();
    model = record_model();
    measure_sizes();
    measure_clock();
    measure_push();
    measure_first_push();
    measure_steady();
    measure_varying();
    measure_hour();
    measure_report();
    measure_telemetry();
#ifdef __ARM_FP
    measure_paper();
#endif
    return 0;
}
