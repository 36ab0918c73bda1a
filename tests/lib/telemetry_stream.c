/* Frames of random reports, with the numbers that went in, for tests/lib/test_wire.py. Not a test of its own.
 *
 *     telemetry_stream SEED REPORTS HYPOTHESES SLOW_MS COLUMNS NODE
 *
 * As a slow module would that takes SLOW_MS for each axis: an axis's report is begun when that of the last is out, with
 * the status every STATUS_MS between. 0: all at once. The hypotheses are a random walk, Gauss-Markov, a constant bias,
 * and these again.
 *
 * Each report: lines `V MESSAGE SIGNAL NUMBER` with what its frames must say, then its frames as SLCAN lines after `F
 * `. */
#include "selfcal.h"

#include "named_laws.h"
#include "slcan.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { AXES = 6, STATUS_MS = 10000 };

static const unsigned order[] = {RANDOM_WALK, GAUSS_MARKOV, CONSTANT};
/* Of those: the places that their parameters have on the wire; NULL: they lack that. */
static const char *const place_name[][SELFCAL_PARAMETERS] = {
    {"N", "p1", NULL, NULL}, {"N", NULL, "p1", "p2"}, {"N", NULL, NULL, NULL}};
enum { LAWS = sizeof order / sizeof order[0] };

static uint32_t state;

static uint32_t random32(void) /* xorshift32, Marsaglia 2003 */
{
    state ^= state << 13;
    state ^= state >> 17;
    state ^= state << 5;
    return state;
}

/* Any sign, 1e-30 to 1e30. */
static float random_float(void) {
    const float sign = (random32() & 1U) != 0U ? -1.0F : 1.0F;
    return sign * powf(10.0F, (float)random32() / 4294967296.0F * 60.0F - 30.0F);
}

/* Of axes_retired, as the DBC words it. */
static unsigned retired_bit(const char *name) {
    return (unsigned)(name[1] - 'x') + (name[0] == 'a' ? 3U : 0U);
}

static float told(const char *message, const char *signal, float number) {
    (void)printf("V %s %s %.17g\n", message, signal, (double)number);
    return number;
}

static uint32_t told_count(const char *message, const char *signal, uint32_t number) {
    (void)printf("V %s %s %lu\n", message, signal, (unsigned long)number);
    return number;
}

static void random_posterior(selfcal_posterior_t *p, const char *message, int k) {
    char signal[64];
    (void)snprintf(signal, sizeof signal, "h%d_probability", k);
    p->probability = told(message, signal, (float)random32() / 4294967296.0F);
    p->ln_evidence = -1e5 + (double)random32() / 4294967296.0 * 1e4;
    (void)printf("V %s h%d_ln_evidence %.17g\n", message, k, p->ln_evidence);
    for (int q = 0; q < SELFCAL_PARAMETERS; q++) {
        const char *place = place_name[k % LAWS][q];
        if (place == NULL) {
            continue;
        }
        static const char *const statistic[] = {"mean", "median", "sd", "q05", "q95"};
        float *const number[] = {&p->parameter[q].mean, &p->parameter[q].median, &p->parameter[q].sd,
                                 &p->parameter[q].q05, &p->parameter[q].q95};
        for (size_t s = 0; s < sizeof number / sizeof number[0]; s++) {
            (void)snprintf(signal, sizeof signal, "h%d_%s_%s", k, place, statistic[s]);
            *number[s] = told(message, signal, random_float());
        }
        (void)snprintf(signal, sizeof signal, "h%d_%s_flags", k, place);
        p->parameter[q].flags = (uint8_t)told_count(message, signal, random32() & 0xFU);
    }
}

static void send_all(selfcal_telemetry_t *telemetry) {
    selfcal_frame_t frame;
    while (selfcal_telemetry_next(telemetry, &frame)) {
        char line[SLCAN_FRAME_BYTES];
        slcan_encode(&frame, line);
        (void)printf("F %.*s\n", SLCAN_FRAME_BYTES - 1, line);
    }
}

static void require(selfcal_status_t status) {
    if (status != SELFCAL_OK) {
        (void)fprintf(stderr, "telemetry refused: %d\n", (int)status);
        exit(1);
    }
}

int main(int argc, char **argv) {
    static const char *const axis_name[AXES] = {"az", "gx", "ay", "gz", "ax", "gy"};
    static const char *const message[AXES] = {"AZ", "GX", "AY", "GZ", "AX", "GY"};
    if (argc != 7) {
        return 2;
    }
    state = (uint32_t)strtoul(argv[1], NULL, 10) * 2654435769U + 1U;
    const unsigned long reports = strtoul(argv[2], NULL, 10);
    const uint8_t hypotheses = (uint8_t)strtoul(argv[3], NULL, 10);
    const uint32_t slow_ms = (uint32_t)strtoul(argv[4], NULL, 10);
    const uint8_t columns = (uint8_t)strtoul(argv[5], NULL, 10);
    const uint8_t node = (uint8_t)strtoul(argv[6], NULL, 10);

    selfcal_axis_t axis[AXES];
    memset(axis, 0, sizeof axis);
    static const selfcal_grid_t grid;
    selfcal_hypothesis_t hypothesis[SELFCAL_HYPOTHESES_MAX];
    memset(hypothesis, 0, sizeof hypothesis);
    for (int k = 0; k < SELFCAL_HYPOTHESES_MAX; k++) {
        hypothesis[k].law = &named_law[order[k % LAWS]];
        hypothesis[k].rho = order[k % LAWS] == CONSTANT ? NULL : &grid;
        hypothesis[k].alpha = order[k % LAWS] == GAUSS_MARKOV ? &grid : NULL;
    }
    selfcal_regressors_t regressors;
    memset(&regressors, 0, sizeof regressors);
    regressors.count = columns;
    selfcal_model_t model;
    memset(&model, 0, sizeof model);
    model.id = random32();
    model.dt_s = 0.5F;
    model.block = 50;
    model.axes = AXES;
    model.hypotheses = hypotheses;
    model.axis = axis;
    model.hypothesis = hypothesis;
    model.regressors = columns > 0U ? &regressors : NULL;

    static selfcal_telemetry_t telemetry;
    require(selfcal_telemetry_init(&telemetry, &model, axis_name));
    require(selfcal_telemetry_node(&telemetry, node));
    for (unsigned long number = 1; number <= reports; number++) {
        /* wraps within the stream */
        const uint32_t time_ms = (uint32_t)(4294940000U + number * 1500U + (number - 1U) * AXES * slow_ms);
        selfcal_counters_t counters;
        memset(&counters, 0, sizeof counters);
        counters.samples = told_count("STATUS", "samples", random32());
        counters.missing = told_count("STATUS", "missing", random32());
        counters.gaps = told_count("STATUS", "gap_count", random32() & 1U);
        counters.blocks_lost = told_count("STATUS", "blocks_lost_count", random32() & 1U);
        counters.blocks_part = told_count("STATUS", "blocks_part_count", random32());
        counters.not_finite[1] = told_count("STATUS", "not_finite_count", random32() & 1U);
        counters.saturated[2] = told_count("STATUS", "saturated_count", random32() & 1U);
        counters.stuck[3] = told_count("STATUS", "stuck_count", random32() & 1U);
        selfcal_module_t module;
        module.reset_cause = told_count("STATUS", "reset_cause", random32());
        module.fault_address = told_count("STATUS", "fault_address", random32());
        module.clock = told_count("STATUS", "clock", random32());
        module.sensor_state = told_count("STATUS", "sensor_state", random32());
        module.sensor_fault = told_count("STATUS", "sensor_fault", random32());
        module.sensor_fault_count = told_count("STATUS", "sensor_fault_count", random32());
        module.sensor_diagnosis = told_count("STATUS", "sensor_diagnosis", random32());
        module.sensor_stale_count = told_count("STATUS", "sensor_stale_count", random32());
        module.sensor_alarm_count = told_count("STATUS", "sensor_alarm_count", random32());
        module.sensor_damaged_count = told_count("STATUS", "sensor_damaged_count", random32());
        module.sensor_anomaly_count = told_count("STATUS", "sensor_anomaly_count", random32());
        module.sensor_overrun_count = told_count("STATUS", "sensor_overrun_count", random32());
        module.frames_dropped = told_count("STATUS", "frames_dropped", random32());
        module.bus_off_count = told_count("STATUS", "bus_off_count", random32());
        module.state_found = told_count("STATUS", "state_found", random32());
        module.state_refused = told_count("STATUS", "state_refused", random32());
        module.state_saves = told_count("STATUS", "state_saves", random32());
        module.state_save_failures = told_count("STATUS", "state_save_failures", random32());
        module.motion = told_count("STATUS", "motion", random32());
        module.gate_alarm_count = told_count("STATUS", "gate_alarm_count", random32());
        counters.blocks_moving = told_count("STATUS", "blocks_moving_count", random32());
        module.command_count = told_count("STATUS", "command_count", random32());
        module.command_refused_count = told_count("STATUS", "command_refused_count", random32());
        module.retired = 0;
        uint32_t retired = 0;
        for (uint8_t a = 0; a < AXES; a++) {
            char signal[] = "offset_??";
            memcpy(signal + 7, axis_name[a], 2);
            module.offset[a] = told("STATUS", signal, random_float());
            const bool is_retired = (random32() & 1U) != 0U;
            module.retired |= is_retired ? 1UL << a : 0U;
            retired |= is_retired ? 1UL << retired_bit(axis_name[a]) : 0U;
            char why[] = "reason_??";
            memcpy(why + 7, axis_name[a], 2);
            module.reason[a] = (selfcal_reason_t)told_count("STATUS", why, random32() % (SELFCAL_REASON_STUCK + 1U));
        }
        (void)told_count("STATUS", "axes_retired", retired);
        selfcal_telemetry_module(&telemetry, &module);
        (void)told_count("STATUS", "time_ms", time_ms);
        (void)told_count("STATUS", "model_id", model.id);
        (void)told_count("STATUS", "bank_block", model.block);
        (void)told("STATUS", "bank_interval", model.dt_s);
        (void)told_count("STATUS", "report", (uint32_t)number);
        (void)told_count("STATUS", "state", number < reports ? 1U : 2U);
        require(selfcal_telemetry_status(&telemetry, &counters, number < reports ? SELFCAL_RUNNING : SELFCAL_FINISHED,
                                         (uint32_t)number, time_ms));
        send_all(&telemetry);
        for (uint8_t a = 0; a < AXES; a++) {
            selfcal_report_t report;
            memset(&report, 0, sizeof report);
            report.axis = a;
            report.n = told_count(message[a], "count", random32());
            const uint32_t begun_ms = time_ms + a * slow_ms;
            (void)told_count(message[a], "time_ms", begun_ms);
            (void)told_count(message[a], "end_time_ms", begun_ms % 16777216U);
            (void)told_count(message[a], "not_finite", counters.not_finite[a]);
            (void)told_count(message[a], "saturated", counters.saturated[a]);
            (void)told_count(message[a], "stuck", counters.stuck[a]);
            counters.outliers[a] = (uint16_t)told_count(message[a], "outliers", random32() & 0xFFFFU);
            (void)told_count(message[a], "gaps", counters.gaps);
            (void)told_count(message[a], "blocks_lost", counters.blocks_lost);
            report.bias_mean = told(message[a], "bias_mean", random_float());
            report.bias_sd = told(message[a], "bias_sd", random_float());
            for (uint8_t k = 0; k < hypotheses; k++) {
                random_posterior(&report.hypothesis[k], message[a], k);
            }
            selfcal_sent_coefficient_t coefficient[SELFCAL_REGRESSORS_MAX];
            for (uint8_t c = 0; c < columns; c++) {
                char signal[] = "c0_probability";
                signal[1] = (char)('0' + c);
                coefficient[c].probability = told(message[a], signal, (float)random32() / 4294967296.0F);
                memcpy(signal + 3, "mean", sizeof "mean");
                coefficient[c].mean = told(message[a], signal, random_float());
                memcpy(signal + 3, "sd", sizeof "sd");
                coefficient[c].sd = told(message[a], signal, random_float());
            }
            (void)told_count(message[a], "hypotheses", hypotheses);
            (void)told_count(message[a], "columns", columns);
            selfcal_telemetry_coefficients(&telemetry, coefficient);
            for (uint32_t after = (a * slow_ms / STATUS_MS + 1U) * STATUS_MS; after <= (a + 1U) * slow_ms;
                 after += STATUS_MS) {
                require(selfcal_telemetry_status(&telemetry, &counters, SELFCAL_RUNNING, (uint32_t)number,
                                                 time_ms + after));
                send_all(&telemetry);
            }
            require(selfcal_telemetry_report(&telemetry, &report, &counters, begun_ms));
            send_all(&telemetry);
        }
    }
    return 0;
}
