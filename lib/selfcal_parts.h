/* The parts of selfcal, for a pipe of one's own: bank, values of regressors, snapshot, report, adequacy, changes, gate,
 * telemetry. selfcal_imu_t (selfcal.h) is one pipe made of them. Include selfcal.h, which includes this file.
 *
 *   1. Give selfcal_init() the model and SELFCAL_MODEL_BYTES of memory.
 *   2. selfcal_push() every sample, selfcal_skip() every missing one. The cost of a push is even: SELFCAL_BATCH bank
 *      samples are gathered, and while the next ones are, each push runs some nodes over them.
 *   3. For a report: selfcal_report_begin(), then selfcal_report_step() until it no longer returns SELFCAL_BUSY.
 *      Samples may be pushed in between, as long as selfcal_room() is above 0.
 * A part that a program does not name is not linked. */
#ifndef SELFCAL_PARTS_H
#define SELFCAL_PARTS_H

#ifdef __cplusplus
extern "C" {
#endif

/* --- bank --- */

typedef struct selfcal selfcal_t; /* of its members, `position` and `used` may be read: samples of this block */

/* Prepare `self` over `memory`, aligned to 8 bytes. `size`: SELFCAL_MODEL_BYTES of the generated header, or the sum of
 * SELFCAL_SIZE, SELFCAL_REGRESSORS_SIZE and SELFCAL_TERMS_SIZE of selfcal_layout.h. Model and memory must outlive the
 * use. Fails with SELFCAL_BAD_ARGUMENT, SELFCAL_BAD_MODEL, SELFCAL_BAD_MEMORY or SELFCAL_BAD_BUILD; then `self` is
 * unusable. `layout`: SELFCAL_LAYOUT as the caller has it. */
static inline selfcal_status_t selfcal_init(selfcal_t *self, const selfcal_model_t *model, void *memory, size_t size);
selfcal_status_t selfcal_init_as(uint32_t layout, selfcal_t *self, const selfcal_model_t *model, void *memory,
                                 size_t size);

/* A sample of this size counts as saturated whatever the range, 2^40. Below it no sum can overflow (intake.c). */
#define SELFCAL_SAMPLE_MAX 1.099511627776e12F

/* Take one sample of every axis, in the model's order and units.
 * A value that is not finite, at the range limit or stuck keeps the whole sample out, because the axes share gains.
 * Time then passes as with selfcal_skip(). O(axes), and a batch of all axes for SELFCAL_PUSH_NODES nodes, or for 2
 * nodes / (block SELFCAL_BATCH) if that is more.
 *
 * Retirement: an axis at fault in more than half of a bank interval's samples spoils the interval for all. After
 * SELFCAL_RETIRE_BLOCKS such intervals in a row it is retired. The others go on exactly as if the model did not have
 * it. Its values are looked at for the fault counters only; its reports and node views say SELFCAL_AXIS_RETIRED. It
 * stays retired until selfcal_init(). A sample in which every axis fails counts for nobody, and the last axis is never
 * retired: a sensor that is unplugged and back goes on after a gap. Intervals are counted in samples pushed, so missing
 * ones neither help nor harm an axis. */
selfcal_status_t selfcal_push(selfcal_t *self, const float sample[]);

/* The same with the values of the model's regressors, in its order. They are averaged over a block as the samples are.
 * A value that is not finite, or at SELFCAL_SAMPLE_MAX, keeps the sample out. A model with regressors takes this call
 * only (else SELFCAL_BAD_ARGUMENT); one without does not look at `regressors`. Per node O(count^2 + axes count)
 * more. */
selfcal_status_t selfcal_push_with(selfcal_t *self, const float sample[], const float regressors[]);

/* True once an axis is retired. */
bool selfcal_retired(const selfcal_t *self, uint8_t axis);

/* `count` samples are missing. The prediction over the gap is exact for up to 2^32 - 1 bank intervals (136 years at 1
 * Hz); a longer gap is taken for that. A block with half or more of its samples counts as their mean. Its white noise
 * is raised by block / used, what a drift moves within the block is not. A block with fewer is dropped. Before the
 * first sample they are counted alone: the first block begins with the first sample. */
selfcal_status_t selfcal_skip(selfcal_t *self, uint64_t count);

/* Motion was seen in the bank interval in progress. It yields no value, and samples until its end count as missing.
 * Nothing happens at the start of an interval. */
selfcal_status_t selfcal_moving(selfcal_t *self);

/* Take a sample that was measured in motion. Its faults count, and retire an axis, as with selfcal_push(); one without
 * faults counts as missing. Otherwise this is selfcal_moving() and selfcal_skip(1).
 * With the gate: every sample goes to selfcal_gate_push() first. If the gate said resting before this sample and says
 * so with it, the sample goes to selfcal_push(), else here. Until the bank has taken its first sample (counters'
 * `samples`), only the first sample of a window (the gate's `position` was 0) goes to selfcal_push(): bank intervals
 * begin there. Then no window of motion reaches back into a closed interval, provided that the block is a multiple of
 * the window. */
selfcal_status_t selfcal_push_moving(selfcal_t *self, const float sample[]);

/* The sampling rate changes: from now on `block` samples make a bank interval, whose length dt stays.
 * `variance_ratio`: white-noise variance of a whole block's mean over its value for the model's block and rate. It is 1
 * where the sensor's own averaging keeps the noise density, model->block / block where single samples stay as noisy.
 * The interval in progress yields no value and goes on to its end, its position scaled to the new block. sigma_v and N
 * remain those of the model's block. The likelihood is exact, but any ratio but 1 costs the full gain computation for
 * every sample. selfcal_within_sd() starts anew. SELFCAL_BAD_ARGUMENT, and nothing changes: a block of 0, or a ratio
 * beyond SELFCAL_VARIANCE_RATIO_MAX or below its inverse. */
#define SELFCAL_VARIANCE_RATIO_MAX 1024.0F
selfcal_status_t selfcal_rate(selfcal_t *self, uint32_t block, float variance_ratio);

/* From the next sample on the sensor itself adds `amount` (unit) to the readings of an axis, say because its offset
 * register was written with the bias. Everything known is kept, and the bias goes up by `amount`. The interval in
 * progress yields no value. Begin a report under way anew. SELFCAL_BAD_ARGUMENT, and nothing changes: no such axis, or
 * `amount` or the sum of all of them is not below SELFCAL_SAMPLE_MAX. Of a retired axis that sum alone is kept. */
selfcal_status_t selfcal_shift(selfcal_t *self, uint8_t axis, float amount);

/* The bias or the noise has changed. What is known of the laws and their parameters is kept; the bias of each axis
 * begins anew from what it is now. O(nodes axes), with logarithms: for rare events. Reports under way are given up
 * (SELFCAL_OVERTAKEN).
 * `at`: of each axis of the model the likeliest law and where it lies. `keep`: the part of what was learned of the
 * noise that is kept, above 0 to 1. `learned`: by selfcal_learned(), from before the change; NULL: there is none.
 * SELFCAL_BAD_ARGUMENT; SELFCAL_BAD_MODEL if the model handles nothing or has regressors; SELFCAL_TOO_SHORT. Method:
 * bank_reopen.c. */
typedef struct {
    uint8_t hypothesis;
    float ln_rho, ln_second; /* of its nodes; ln_second of alpha or the ratio */
    float sigma_v;           /* unit; where it is not above 0 the residuals tell it */
    float bias, bias_sd;     /* unit, of an axis with a step; else bias_sd is 0. Such an axis takes what was learned
                                before, since the readings after the step say something else. */
} selfcal_reopening_t;
selfcal_status_t selfcal_reopen(selfcal_t *self, const selfcal_reopening_t at[], float keep, const float learned[]);

/* What the bank knows of the noise and the drift now, for selfcal_reopen(): `learned` [nodes][axes]. O(nodes axes). */
void selfcal_learned(selfcal_t *self, float learned[]);

/* The following take a bank that selfcal_init() has prepared and an axis of its model. Anything else is a bug. */

/* Bank samples in the sums, those on their way into them included. */
uint32_t selfcal_count(const selfcal_t *self);

/* Bank samples that may still come before the nodes run on, which ends a report under way (SELFCAL_OVERTAKEN). */
uint32_t selfcal_room(const selfcal_t *self);

const selfcal_counters_t *selfcal_counters(const selfcal_t *self);

/* Standard deviation of samples about their block's mean, pooled, unit. NaN with a block of 1, before the first whole
 * block, and of a retired axis. White noise makes it sigma_v sqrt(block). More says coloured noise or vibration. */
float selfcal_within_sd(const selfcal_t *self, uint8_t axis);

/* Sum of the amounts given to selfcal_shift() for an axis, unit. A snapshot keeps it. */
float selfcal_shifted(const selfcal_t *self, uint8_t axis);

/* Offset (unit) that is taken off an axis before the filters: its first bank sample. */
selfcal_wide_t selfcal_offset(const selfcal_t *self, uint8_t axis);

/* Whether pushes and skips can have made the bank: pointers, places within their arrays, counts that fit each other,
 * sums finite and of the right sign. SELFCAL_CORRUPT: memory was overwritten, by a bug or by a fault; nothing but
 * selfcal_init() or selfcal_restore() should follow. SELFCAL_BAD_ARGUMENT on NULL. O(nodes axes), no logarithm, no
 * division. */
selfcal_status_t selfcal_check(const selfcal_t *self);

/* --- values of regressors ---
 * For a model whose regressors name their sources. The host's tools form the columns of a recording by the same
 * code. */

/* The windows of a model's columns, in selfcal_layout.h. */
typedef struct selfcal_former selfcal_former_t;

/* Begin at the first sample.
 * SELFCAL_BAD_ARGUMENT: null pointer, or regressors without sources. SELFCAL_BAD_MODEL: a source that cannot be
 * formed. */
selfcal_status_t selfcal_former_init(selfcal_former_t *self, const selfcal_model_t *model);

/* Values of all regressors at a sample that follows `missing` absent ones, for selfcal_push_with().
 * `channels`: the values beside the readings, as the sources count them; NULL if there are none.
 * A channel that is not finite gives a value that is not finite. The bank keeps that sample out and counts it. */
void selfcal_form(selfcal_former_t *self, uint32_t missing, const float sample[], const float channels[],
                  float values[]);

/* Value of regressor k at the last bank sample that the sums hold: where the bias of a report with it in use stands. */
float selfcal_regressor_last(const selfcal_t *self, uint8_t k);

/* selfcal_former_init() where the bank has got to, as after selfcal_restore(). Times, lines and turn-ons go on. A lag
 * goes on from its value at the bank's last sample; meanwhile the channel is taken to have had its next value. A window
 * begins anew. SELFCAL_BAD_ARGUMENT, SELFCAL_BAD_MODEL: as selfcal_former_init(). */
selfcal_status_t selfcal_former_resume(selfcal_former_t *self, const selfcal_t *bank);

/* The part was powered on `samples` before the next sample; without this, at the first of all. A snapshot has it.
 * Call it before selfcal_former_resume(): at a start where power came on, with 0, or a recording that begins later.
 * SELFCAL_BAD_ARGUMENT on NULL. */
selfcal_status_t selfcal_power_on(selfcal_t *self, uint64_t samples);

/* --- snapshot ---
 * Everything a bank knows as a stream of bytes (format in snapshot.c), with a version and a CRC-32. A bank saved and
 * restored goes on bit for bit like one that was never stopped, whatever was under way: a block, a batch, a gap. A
 * snapshot belongs to its model and its build. A report under way and telemetry are not part of it. */

/* selfcal_save() writes this many bytes at a time, and the rest at last. */
#define SELFCAL_SNAPSHOT_CHUNK 64U

/* Bytes selfcal_save() writes; the same at any time of a bank's life. 0 on NULL. For a slot or buffer that the compiler
 * lays out, SELFCAL_SNAPSHOT_MAX(SELFCAL_MODEL_BYTES) is a bound. */
size_t selfcal_snapshot_size(const selfcal_t *self);

/* Write the bank. It is not changed, and not flushed. SELFCAL_WRITE_FAILED. SELFCAL_CORRUPT if selfcal_check() fails:
 * nothing is written, so that the last good snapshot stays. SELFCAL_BAD_ARGUMENT on NULL. */
selfcal_status_t selfcal_save(const selfcal_t *self, selfcal_write_t write, void *context);

/* selfcal_init(), then the state that `snapshot` holds: `length` bytes, aligned or not, all of them and no more.
 * `model` must be the saved bank's, known by its id, axes and nodes; the build must have the same configuration.
 * Refused with one of SELFCAL_SNAPSHOT_..., or as by selfcal_init(): `self` and `memory` are as they were.
 * SELFCAL_CORRUPT (the checksum fits contents that no bank can have): `self` is as selfcal_init() leaves it, without a
 * sample. O(nodes axes). */
static inline selfcal_status_t selfcal_restore(selfcal_t *self, const selfcal_model_t *model, void *memory, size_t size,
                                               const void *snapshot, size_t length);
selfcal_status_t selfcal_restore_as(uint32_t layout, selfcal_t *self, const selfcal_model_t *model, void *memory,
                                    size_t size, const void *snapshot, size_t length);

/* --- report --- */

/* Coefficients of the regressors under one hypothesis, unit per unit of each; NaN for those not in use. */
typedef struct {
    float mean[SELFCAL_REGRESSORS_MAX], sd[SELFCAL_REGRESSORS_MAX];
    selfcal_wide_t moment[3][SELFCAL_REGRESSORS_MAX]; /* under way */
} selfcal_coefficients_t;

/* Scratch of a report under way. All axes may share it. `gathered` may be read: samples from now on come later than the
 * report. */
typedef struct selfcal_work selfcal_work_t;

/* Start a report on one axis. SELFCAL_TOO_SHORT if there are too few samples. Of a bank that forgets, the first step
 * that looks at its sums says so too. A report that does not begin leaves its axis in `report` and no number of
 * another: the bias is NaN, probabilities are 0. */
selfcal_status_t selfcal_report_begin(selfcal_work_t *work, selfcal_t *self, uint8_t axis, selfcal_report_t *report);

/* The same with the regressors of `mask` in use, a bit each: one subset, whose ln_evidence compares with the others'.
 * Bias then means x0 + c' z + drift with z of the last bank sample. `coefficients`: room for one a hypothesis, or NULL.
 * SELFCAL_BAD_ARGUMENT also if the axis does not have them all. SELFCAL_TOO_SHORT with fewer than SELFCAL_REPORT_MIN
 * samples and one more for each. */
selfcal_status_t selfcal_report_begin_subset(selfcal_work_t *work, selfcal_t *self, uint8_t axis, uint8_t mask,
                                             selfcal_coefficients_t coefficients[], selfcal_report_t *report);

/* Take one step, below 61 000 instructions on a Cortex-M4F; with regressors in use, one node's least squares.
 * SELFCAL_BUSY while there is more to do, SELFCAL_OK when `report` is whole. A report first runs the nodes over the
 * gathered samples. Then the sums must rest: after SELFCAL_BATCH further bank samples, or fewer and a call that looks
 * at the sums, it is SELFCAL_OVERTAKEN; begin anew. After either end there is no report under way:
 * SELFCAL_BAD_ARGUMENT. */
selfcal_status_t selfcal_report_step(selfcal_work_t *work, selfcal_report_t *report);

/* All steps in a row. */
selfcal_status_t selfcal_report(selfcal_work_t *work, selfcal_t *self, uint8_t axis, selfcal_report_t *report);

/* Bias of the report's axis and its standard deviation, `elapsed_s` after the last bank interval that the report rests
 * on (missing ones included), over all hypotheses, in the axis's unit. A reading less `bias` is the corrected reading,
 * at rest or moving. Under the constant law the bias stays. Under the random walk its variance grows by E(K^2) per
 * second. A Gauss-Markov term decays towards 0 and its variance grows to sigma_m^2. NaN where the report's own are.
 * `model` is the bank's. SELFCAL_BAD_ARGUMENT: null pointer, elapsed_s negative or not finite. O(alpha nodes). */
selfcal_status_t selfcal_predict(const selfcal_report_t *report, const selfcal_model_t *model, float elapsed_s,
                                 float *bias, float *sd);

/* --- adequacy ---
 * Whether the model of the last report explains the readings after it. Optional: a program that does not name these
 * functions pays nothing for them. Method: adequacy.c.
 *
 *     selfcal_adequacy_init(&adequacy, &bank);
 *     each sample:  selfcal_push(...); selfcal_adequacy_push(&adequacy, &bank, channels, NULL);
 *     each report:  selfcal_adequacy_report(&adequacy, &model, &report, NULL);
 *     at any time:  selfcal_judgement(&adequacy, &bank, axis).state
 */

/* An epoch, bank samples. At its end each axis is judged. */
#define SELFCAL_EPOCH_MIN 256U
#define SELFCAL_EPOCH_MAX 4096U
/* Scores beyond these make a model inadequate. One false flag in 1000 h over six axes at 1 Hz: tests/ACCURACY.md. */
#define SELFCAL_ADEQUACY_LIMIT 5.0F
#define SELFCAL_ADEQUACY_LIMIT_EARLY 8.0F /* of ramp, colored_noise and flicker over fewer bank samples than that: */
#define SELFCAL_ADEQUACY_EARLY 1024U
#define SELFCAL_ADEQUACY_LIMIT_TONE 4.5F /* a slow line: the score is made for a line, and nothing else adds to it */
#define SELFCAL_ADEQUACY_LIMIT_VARIANCE 6.0F
#define SELFCAL_ADEQUACY_LIMIT_KURTOSIS 13.0F

/* Why the calibration in a report is not to be relied on. `state`: of the axis's last judgement.
 * The first that applies of SELFCAL_REASON_OUTSIDE_PRIORS, _INADEQUATE, _NOT_IDENTIFIED and _NONE. */
selfcal_reason_t selfcal_reason(const selfcal_model_t *model, const selfcal_report_t *report,
                                selfcal_adequacy_state_t state);

typedef struct selfcal_adequacy selfcal_adequacy_t;

/* Begin; after selfcal_init() and selfcal_restore() of the bank. */
selfcal_status_t selfcal_adequacy_init(selfcal_adequacy_t *self, const selfcal_t *bank);

/* After each selfcal_push() or selfcal_push_with(). `channels`: temperature and supply. For a value that is not finite
 * the one before stands. NULL: neither is known. `values`: of the regressors; NULL without any. O(axes^2) at an
 * interval's end. */
void selfcal_adequacy_push(selfcal_adequacy_t *self, const selfcal_t *bank, const float channels[],
                           const float values[]);

/* After each report. `coefficient`: of each regressor in use, 0 of the others; NULL: none is in use. */
void selfcal_adequacy_report(selfcal_adequacy_t *self, const selfcal_model_t *model, const selfcal_report_t *report,
                             const float coefficient[]);

/* The judgement of the last epoch, and the last change. */
selfcal_judgement_t selfcal_judgement(const selfcal_adequacy_t *self, const selfcal_t *bank, uint8_t axis);

/* --- changes ---
 * Steps of the bias and changes of the noise, found while the samples come, for a model whose `handling` says so.
 * Method, false-alarm rates and delays: changes.c.
 *
 *     selfcal_changes_init(&changes, &adequacy, &bank, learned);
 *     each sample, after selfcal_adequacy_push():
 *         if (selfcal_changes_handle(&adequacy, &bank) != 0) { ask for a report; selfcal_judgement() has the changes }
 */

typedef struct selfcal_changes selfcal_changes_t;

/* After selfcal_adequacy_init(). `learned`: memory for [nodes][axes], which must outlive the use. SELFCAL_BAD_ARGUMENT
 * on a null pointer. SELFCAL_BAD_MODEL if the model handles neither. */
selfcal_status_t selfcal_changes_init(selfcal_changes_t *self, selfcal_adequacy_t *adequacy, const selfcal_t *bank,
                                      float learned[]);

/* Call it after each sample; from time to time it keeps what was learned. Returns a bit for each axis that has changed.
 * Then the bank has been reopened (selfcal_reopen()): after a step the bias of such an axis is learned anew; after a
 * change of variance all noise learned before it is forgotten. */
uint32_t selfcal_changes_handle(selfcal_adequacy_t *adequacy, selfcal_t *bank);

/* --- gate ---
 * Does the sensor rest? A likelihood-ratio test over windows of samples of any axes (gyros, accelerometers, or both).
 * gate.c states the hypotheses, the statistics and their distributions. Independent of selfcal_t. */

typedef enum { SELFCAL_MOVING = 0, SELFCAL_RESTING = 1 } selfcal_motion_t;

/* Of its members may be read: state, counters, position (samples passed of this window), t1 and t2 (the last window's
 * statistics), shaken_above, moved_above and rate_moved_above (their thresholds). */
typedef struct selfcal_gate selfcal_gate_t;

struct selfcal_gate_config {
    uint8_t axes;
    uint32_t window; /* samples, 2 or more; a divisor of the bank's block, see selfcal_push_moving() */
    /* probability that a window of rest is taken for motion, up to 0.1; 0: never, to measure noise */
    float false_alarm;
    /* windows in a row, after a first one, that must be quiet and on one level before motion is over; 1 or more */
    uint32_t hold;
    /* likewise to take a new gyro level, or more noise, for rest; 0: never. Below `hold`: no effect */
    uint32_t settle;
    /* windows that the level at rest is averaged over, 1 or more. Over as many the bias must not drift by more than the
     * noise of a window's mean. */
    uint32_t memory;
    /* noise of one sample at rest: N sqrt(sampling rate); INFINITY leaves the axis out */
    float sigma[SELFCAL_AXES_MAX];
    bool is_rate[SELFCAL_AXES_MAX]; /* a gyro: after a motion it must read what it read before. Others may rest at a new
                                       level. */
};

/* Noise of one axis at rest; the factors are 1 where it is white. */
typedef struct {
    float sigma;  /* of one sample, unit; INFINITY leaves the axis out (absent, retired) */
    float within; /* mean square about the window's mean over sigma^2 */
    float spread; /* variance of that mean square over its value for white noise */
    float level;  /* variance of a window's mean over sigma^2/window */
} selfcal_gate_noise_t;

/* Monotonic since selfcal_gate_init(). */
typedef struct {
    uint64_t windows;
    uint64_t shaken; /* windows that scatter too much */
    uint64_t moved;  /* windows off the level of the rest, or of the quiet windows, before */
    uint64_t blind;  /* windows with a sample that is no number (or at SELFCAL_SAMPLE_MAX), or less than half full */
    uint64_t alarms; /* times that rest ended by a shaken or moved window */
} selfcal_gate_counters_t;

/* Starts as moving. SELFCAL_BAD_ARGUMENT if the configuration is not as said above. */
selfcal_status_t selfcal_gate_init(selfcal_gate_t *gate, const selfcal_gate_config_t *config);

/* Take one sample of every axis; return the state.
 * The state changes at the end of a window, so it is at most one window late. A non-finite sample ends rest at once.
 *   RESTING -> MOVING   after one window that is shaken, moved or blind.
 *   MOVING -> RESTING after hold + 1 quiet windows in a row on one level. Gyros must also have returned to the level of
 *                       the last rest. After blind windows, one quiet window on the level of the rest before is enough.
 * A gyro that stays off that level for `settle` windows is believed to have a new bias, for a rotation at a constant
 * rate is nothing else to a gyro. So is noise that has grown, up to the noise that the gate started from. Blind windows
 * do not count in a row and do not end one. A false alarm costs hold + 2 windows.
 * O(axes). Thresholds are worked out in steps, one with each sample, below 10 000 instructions on a Cortex-M4F: up to
 * 60 steps from the start on, 30 from a change of noise on. At a window's end the missing ones are worked out there:
 * all of them where windows are shorter than that, and one, 70 000 instructions, for a window with missing samples. */
selfcal_motion_t selfcal_gate_push(selfcal_gate_t *gate, const float sample[]);

/* `count` samples are missing; windows keep their grid. A window with half or more of its samples is judged by them. */
selfcal_motion_t selfcal_gate_skip(selfcal_gate_t *gate, uint64_t count);

/* Take the noise of an axis from now on, say once N is identified. SELFCAL_BAD_ARGUMENT: null pointer, no such axis, a
 * value that is not above 0, or a factor that is infinite. */
selfcal_status_t selfcal_gate_noise(selfcal_gate_t *gate, uint8_t axis, const selfcal_gate_noise_t *noise);

/* The sensor itself adds `amount` (unit) to the readings of an axis from the next sample on, see selfcal_shift(): no
 * motion. An axis that the gate does not have, or an amount that is not finite, is a bug. */
void selfcal_gate_shift(selfcal_gate_t *gate, uint8_t axis, float amount);

/* The noise as measured over the whole windows of rest so far, for selfcal_gate_noise(). Run with false_alarm 0 while
 * the sensor is known to rest, and with the sigma that is to be used. Each factor's relative error is about
 * sqrt(2/windows). SELFCAL_TOO_SHORT below SELFCAL_GATE_MEASURED_MIN windows. */
#define SELFCAL_GATE_MEASURED_MIN 30U
selfcal_status_t selfcal_gate_measured(const selfcal_gate_t *gate, uint8_t axis, selfcal_gate_noise_t *noise);

/* --- telemetry ---
 * Reports as classical CAN frames of 8 bytes with 11-bit identifiers. selfcal.dbc describes every item, with its unit
 * and bits. selfcal_frames.h and the decoders are made from the same source.
 * Each frame carries one value and its item number, a counter over all frames of the module, the module time in whole
 * seconds modulo 256, and a CRC-12.
 * A report's opening and end do not depend on the laws. Between them each hypothesis has a message of its own. It
 * carries up to three parameters by place: N; the drift parameter; the bandwidth or ratio. A place that the law lacks
 * is not sent. So any model of up to eight hypotheses fits, and the same law may stand twice.
 * Up to twelve modules share a bus: the node number moves all identifiers.
 * Frames must reach the wire in the order they are made (bxCAN: set TXFP). */

typedef struct {
    uint16_t id; /* 11 bits */
    uint8_t length;
    uint8_t data[8];
} selfcal_frame_t;

/* State of the module, for its status: finished once no sample will follow. */
typedef enum { SELFCAL_RUNNING, SELFCAL_FINISHED } selfcal_state_t;

/* A module's state beside the bank; meanings and codes as in selfcal.dbc. */
typedef struct {
    uint32_t reset_cause;
    uint32_t fault_address;
    uint32_t clock;
    uint32_t sensor_state;
    uint32_t sensor_fault;
    uint32_t sensor_fault_count;
    uint32_t sensor_diagnosis;
    uint32_t sensor_stale_count;
    uint32_t sensor_alarm_count;
    uint32_t sensor_damaged_count;
    uint32_t sensor_anomaly_count;
    uint32_t sensor_overrun_count;
    uint32_t frames_dropped;
    uint32_t bus_off_count;
    uint32_t state_found;
    uint32_t state_refused;
    uint32_t state_saves;
    uint32_t state_save_failures;
    uint32_t motion;
    uint32_t gate_alarm_count;
    uint32_t retired;                          /* a bit for each axis of the model */
    selfcal_reason_t reason[SELFCAL_AXES_MAX]; /* why an axis has no calibration to rely on */
    uint32_t command_count;
    uint32_t command_refused_count;
    /* of each axis of the model, unit: added by the sensor itself, see selfcal_shift() */
    float offset[SELFCAL_AXES_MAX];
} selfcal_module_t;

typedef struct selfcal_telemetry selfcal_telemetry_t;

/* `axis_name[]`: the name of each axis of the model, which chooses its message: gx gy gz (deg/s), ax ay az (m/s^2). The
 * model's units must be those. The node is 0. SELFCAL_BAD_ARGUMENT on a null pointer. SELFCAL_BAD_MODEL if a name has
 * no message or comes twice, or if the model has more than eight hypotheses. */
selfcal_status_t selfcal_telemetry_init(selfcal_telemetry_t *self, const selfcal_model_t *model,
                                        const char *const axis_name[]);

/* The module's number on its bus, 0 to 11, from here on. SELFCAL_BAD_ARGUMENT beyond. SELFCAL_BUSY, and nothing
 * changes, while frames are still to be fetched. */
selfcal_status_t selfcal_telemetry_node(selfcal_telemetry_t *self, uint8_t node);

/* Least probability of a law that may be true. */
#define SELFCAL_LIKELY 0.05

/* Mean and sd of each column's coefficient, of a report made with all of them in use, under the law that leaves it most
 * open, of those that may be true. A record of an hour does not tell a walk from a Gauss-Markov drift, beside which a
 * ramp seems known two to four times better: an average over the laws holds too few. */
void selfcal_widest_coefficients(const selfcal_report_t *report, const selfcal_model_t *model,
                                 const selfcal_coefficients_t coefficients[], float probability,
                                 selfcal_sent_coefficient_t sent[]);

/* Coefficients for the following reports, by column of the model, on their axis. They must stay as the report must.
 * NULL, as at the start: none. */
void selfcal_telemetry_coefficients(selfcal_telemetry_t *self, const selfcal_sent_coefficient_t column[]);

/* The adequacy that goes with the next report; it must stay until the report is out. NULL: none is sent. */
void selfcal_telemetry_adequacy(selfcal_telemetry_t *self, const selfcal_judgement_t *judgement);

/* Sends one axis's report next: 7 frames, and of each hypothesis 3 and 5 for each of its parameters. The paper's three
 * laws take 46. Each coefficient takes 3 more. `time_ms`: module time since its start, modulo 2^32, later than that of
 * the axis's last report. `report` and `counters` must stay, the report unchanged, until selfcal_telemetry_next() says
 * false. SELFCAL_BUSY, and nothing changes, while frames are still to be fetched. */
selfcal_status_t selfcal_telemetry_report(selfcal_telemetry_t *self, const selfcal_report_t *report,
                                          const selfcal_counters_t *counters, uint32_t time_ms);

/* The module's state for the following statuses; it must stay. NULL: zeros. */
void selfcal_telemetry_module(selfcal_telemetry_t *self, const selfcal_module_t *module);

/* Sends the status next, 46 frames; otherwise as selfcal_telemetry_report(). */
selfcal_status_t selfcal_telemetry_status(selfcal_telemetry_t *self, const selfcal_counters_t *counters,
                                          selfcal_state_t state, uint32_t report_number, uint32_t time_ms);

/* Sends a corrected sample next, up to 14 frames; otherwise as selfcal_telemetry_report(). */
selfcal_status_t selfcal_telemetry_corrected(selfcal_telemetry_t *self, const selfcal_corrected_t *corrected,
                                             uint32_t time_ms);

/* Sends one item of the answer message next; otherwise as selfcal_telemetry_report(). SELFCAL_BAD_ARGUMENT also if
 * there is no such item. */
selfcal_status_t selfcal_telemetry_answer(selfcal_telemetry_t *self, uint8_t item, uint32_t value, uint32_t time_ms);

/* Sends a message of node 0's identifier `id` next, whose values are made elsewhere: item 0 is the time, item k has
 * word[k - 1] if bit k - 1 of `there` is set, and is left out if not. `word` must stay; otherwise as
 * selfcal_telemetry_report(). SELFCAL_BAD_ARGUMENT also if `count` is not 1 to 32. */
selfcal_status_t selfcal_telemetry_words(selfcal_telemetry_t *self, uint32_t id, const uint32_t word[], uint8_t count,
                                         uint32_t there, uint32_t time_ms);

/* Makes the next frame; false when there is none. O(1). */
bool selfcal_telemetry_next(selfcal_telemetry_t *self, selfcal_frame_t *frame);

/* --- for tests and tools --- */

/* Number format of one axis with SELFCAL_FIXED, and how far it is filled. Nothing ever saturates: the step grows. */
typedef struct {
    int16_t exponent;        /* step of y and drift now: 2^exponent unit */
    uint16_t coarser, finer; /* times the exponent has grown and shrunk */
    int32_t most_y;          /* greatest |y| at this exponent; beyond SELFCAL_FIXED_LIMIT the step grows */
    int32_t most_sum;        /* greatest of the sums C and |B| over 2^32; from 2^29 on the step grows */
} selfcal_scale_t;
#define SELFCAL_FIXED_LIMIT (3 * (1L << 25))
const selfcal_scale_t *selfcal_scale(const selfcal_t *self, uint8_t axis);

/* State of one node for one axis, for tests and tools. The call folds the batch first, hence it is not const. */
typedef struct {
    uint8_t hypothesis;
    selfcal_wide_t ln_rho, ln_alpha; /* the node; NaN where the law has none */
    selfcal_wide_t a, b, c, ln_s;    /* sums A, B, C about the offset, and D, see bank.c */
    selfcal_wide_t drift;            /* at the end of the last interval, if x0 were the offset */
    selfcal_wide_t bias_left;        /* change of x0 + drift at the end of the last interval per unit of x0 */
    selfcal_wide_t drift_var;        /* variance of the drift there, given x0, over sigma_v^2 */
} selfcal_node_view_t;
selfcal_status_t selfcal_node(selfcal_t *self, uint8_t axis, uint16_t index, selfcal_node_view_t *view);

/* Exact ln p(Y | node, sigma_v) of everything pushed on one axis, x0 integrated out; sigma_v in unit per interval. */
selfcal_status_t selfcal_log_likelihood(selfcal_t *self, uint8_t axis, uint16_t node, selfcal_wide_t sigma_v,
                                        selfcal_wide_t *ln_p);

/* The same with the regressors of `mask` in use, a bit each. SELFCAL_BAD_ARGUMENT if the axis does not have them
 * all. */
selfcal_status_t selfcal_log_likelihood_subset(selfcal_t *self, uint8_t axis, uint16_t node, uint8_t mask,
                                               selfcal_wide_t sigma_v, selfcal_wide_t *ln_p);

/* CRC-12/CDMA2000: polynomial 0xF13, initial value 0xFFF, most significant bit first. */
uint16_t selfcal_crc12(const uint8_t *data, size_t length);

#ifdef __cplusplus
}
#endif

#endif
