/* Counts per (node, sample, axis) what regressors cost, or with BENCH_SUMS the laws that are sums; and the default
 * model, which has neither, in such an image and in one without their code (-DBENCH_PLAIN). Prints as count.h says. */
#include "count.h"
#include "bank_inside.h"
#include "record.h"

#if defined(BENCH_SUMS)
#include "../common/named_laws.h"
#endif

#define AXES SELFCAL_MODEL_AXES
/* Bank samples counted at a time: whole batches. Of sums fewer, since they take an emulated Cortex-M0 a while. */
#define WINDOW (SELFCAL_TERMS_MAX > 1 ? 32U : 64U)
/* Bank samples within which the filters of fast drifts settle. */
#define SETTLED_BY 5000U
#if defined(BENCH_SUMS)
#define SUM_GRID 6U /* nodes a dimension; none costs more or less than another */
#define BYTES (SELFCAL_SIZE(SUM_GRID * SUM_GRID, AXES) + SELFCAL_TERMS_SIZE(SUM_GRID * SUM_GRID, AXES, 0U))
#elif defined(BENCH_PLAIN)
#define BYTES 0U
#else
#define MOST_COLUMNS SELFCAL_REGRESSORS_MAX
#define WALK_NODES 20U /* of the random walk, at most */
#define BYTES (SELFCAL_SIZE(WALK_NODES, AXES) + SELFCAL_REGRESSORS_SIZE(WALK_NODES, AXES, MOST_COLUMNS))
#endif
#define PLAIN_BYTES SELFCAL_SIZE(SELFCAL_MODEL_NODES, AXES)

static uint64_t memory[((BYTES > PLAIN_BYTES ? BYTES : PLAIN_BYTES) + 7U) / 8U];
static selfcal_t bank;
static record_t record;
static float window[WINDOW][AXES];
static selfcal_axis_t axis[AXES];

/* Pushes a window of new samples, with as many values of regressors as the model has. */
static taken_t push_window(void) {
    static float z[WINDOW][SELFCAL_REGRESSORS_MAX];
    const unsigned columns = bank.model->regressors != NULL ? bank.model->regressors->count : 0U;
    for (unsigned i = 0; i < WINDOW; i++) {
        record_next(&record, window[i]);
        for (unsigned k = 0; k < columns; k++) {
            z[i][k] = window[i][k] + (float)(k + 1U);
        }
    }
    const image_time_t start = image_now();
    for (unsigned i = 0; i < WINDOW; i++) {
        (void)selfcal_push_with(&bank, window[i], z[i]);
    }
    return count_since(start);
}

/* Node samples with gains that rest. Filters over readings alone go on to level, where u rests too. */
static uint64_t steady_samples(void) {
    uint64_t sum = 0;
    for (unsigned j = 0; j < bank.model->nodes; j++) {
        sum += bank.node[j].steady;
    }
    return sum;
}

/* One window of a new bank over `model`: with fast drifts once all filters have settled, with slow ones near its
 * beginning. */
static void measure(const char *name, const selfcal_model_t *model, bool fast, bool levels) {
    record_init(&record);
    count_require(selfcal_init(&bank, model, memory, sizeof memory) == SELFCAL_OK, "init");
    (void)push_window();
    const uint64_t whole = (uint64_t)WINDOW * model->nodes;
    for (;;) {
        const bool level = !levels || record_settled(&bank) == model->nodes;
        const uint64_t before = steady_samples();
        const taken_t taken = push_window();
        const uint64_t steady = steady_samples() - before;
        if (!fast || (level && steady == whole)) {
            count_require(fast || steady < whole, "filters vary");
            count_print(name, taken, whole * AXES);
            return;
        }
        count_require(selfcal_count(&bank) <= SETTLED_BY, "every filter settles");
    }
}

#if defined(BENCH_SUMS)

static void measure_sum(const char *name, unsigned law, bool fast) {
    static const selfcal_real_t fit[SUM_GRID * SUM_GRID] = {0}; /* for reports, which there are none of */
    static const selfcal_grid_t grid = {SUM_GRID, fit};
    static const selfcal_prior_t ratio = {-1.0F, 1.0F, SELFCAL_LOG_UNIFORM, false};
    selfcal_prior_t prior[AXES][SELFCAL_PARAMETERS];
    selfcal_model_t model = record_narrow_model(fast, axis);
    for (unsigned a = 0; a < AXES; a++) {
        for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
            prior[a][p] = law != FLICKER && p == SELFCAL_RATIO ? ratio : axis[a].prior[p];
        }
    }
    model.states = &selfcal_states_code;
    const selfcal_hypothesis_t hypothesis = {&named_law[law], 0.0F, &grid, &grid, &prior[0][0]};
    model.hypothesis = &hypothesis;
    model.hypotheses = 1;
    model.nodes = SUM_GRID * SUM_GRID;
    measure(name, &model, fast, false);
}

static void measure_all(void) {
    measure_sum("flicker.steady", FLICKER, true);
    measure_sum("flicker.varying", FLICKER, false);
    measure_sum("moving_average.steady", MOVING_AVERAGE, true);
    measure_sum("moving_average.varying", MOVING_AVERAGE, false);
    measure_sum("walk_and_markov.steady", WALK_AND_MARKOV, true);
    measure_sum("walk_and_markov.varying", WALK_AND_MARKOV, false);
}

#elif defined(BENCH_PLAIN)

/* A bank sample of the judgement, with channels that vary. */
static taken_t judge_next(selfcal_adequacy_t *adequacy) {
    record_next(&record, window[0]);
    (void)selfcal_push(&bank, window[0]);
    const float part = (float)(adequacy->count % 100U), side[] = {25.0F + 0.01F * part, 5.0F - 0.001F * part};
    const image_time_t start = image_now();
    selfcal_adequacy_push(adequacy, &bank, side, NULL);
    return count_since(start);
}

/* The judgement of the model, per (bank sample, axis), under a law of the default model, and the bank sample that ends
 * its epoch; and with it the search for changes. */
static void measure_adequacy(const char *name, const char *name_of_end, unsigned law, bool changes) {
    static const selfcal_handling_t handling = {0.0F, true, true};
    static selfcal_changes_t found;
    static float learned[1];
    static selfcal_adequacy_t adequacy;
    static selfcal_report_t report;
    selfcal_model_t model = record_narrow_model(false, axis);
    model.handling = changes ? &handling : NULL;
    record_init(&record);
    count_require(selfcal_init(&bank, &model, memory, sizeof memory) == SELFCAL_OK, "init");
    while (selfcal_count(&bank) < SELFCAL_EPOCH_MIN + WINDOW) { /* whole batches are known */
        (void)push_window();
    }
    (void)selfcal_adequacy_init(&adequacy, &bank);
    (void)selfcal_changes_init(&found, &adequacy, &bank, learned);
    for (unsigned h = 0; h < model.hypotheses; h++) {
        report.hypothesis[h].probability = h == law ? 1.0F : 0.0F;
        for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
            report.hypothesis[h].parameter[p].median = 0.01F;
            report.hypothesis[h].parameter[p].q95 = 0.01F;
        }
    }
    for (report.axis = 0; report.axis < AXES; report.axis++) {
        selfcal_adequacy_report(&adequacy, &model, &report, NULL);
    }
    report.axis = 0;
    do { /* after the first epoch all of it is under way */
        (void)judge_next(&adequacy);
    } while (adequacy.count < adequacy.length);
    taken_t taken = {0, 0, 0};
    for (unsigned i = 0; i < WINDOW; i++) {
        count_add(&taken, judge_next(&adequacy));
    }
    count_require(adequacy.count == WINDOW, "every bank sample is judged");
    count_print(name, taken, (uint64_t)WINDOW * AXES);
    while (adequacy.count < adequacy.length) {
        taken = judge_next(&adequacy);
    }
    count_print(name_of_end, taken, 1U);
}

static void measure_all(void) {
    measure_adequacy("adequacy.random_walk", "adequacy.random_walk.end", 1U, false);
    measure_adequacy("adequacy.gauss_markov", "adequacy.gauss_markov.end", 2U, false);
    measure_adequacy("changes.random_walk", "changes.random_walk.end", 1U, true);
}

#else

/* The default model's random walk with so many regressors. */
static void measure_columns(const char *name, uint8_t columns, bool fast) {
    float zero[MOST_COLUMNS] = {0.0F}, sd[AXES * MOST_COLUMNS];
    for (unsigned k = 0; k < AXES * MOST_COLUMNS; k++) {
        sd[k] = 1.0F;
    }
    selfcal_model_t model = record_narrow_model(fast, axis);
    const selfcal_regressors_t regressors = {&selfcal_regressors_code, columns, zero, sd, NULL, NULL, NULL};
    model.regressors = columns > 0U ? &regressors : NULL;
    while (model.hypothesis->law->terms == 0U || model.hypothesis->law->term[0].kind != SELFCAL_WALK) {
        model.hypothesis++;
    }
    model.hypotheses = 1;
    model.nodes = model.hypothesis->rho->nodes;
    count_require(model.nodes <= WALK_NODES, "WALK_NODES");
    measure(name, &model, fast, columns == 0U);
}

static void measure_all(void) {
    measure_columns("p0.steady", 0U, true);
    measure_columns("p0.varying", 0U, false);
    measure_columns("p1.steady", 1U, true);
    measure_columns("p1.varying", 1U, false);
    measure_columns("p3.steady", 3U, true);
    measure_columns("p3.varying", 3U, false);
    measure_columns("p6.steady", 6U, true);
    measure_columns("p6.varying", 6U, false);
}

#endif

int main(void) {
    image_start_clock();
    count_print_empty();
    const selfcal_model_t fast = record_narrow_model(true, axis);
    measure("without", &fast, true, true);
    measure_all();
    return 0;
}
