/* The whole calibration from rests in several positions: accelerometers' bias, scale and misalignment, gyros' bias and
 * g-sensitivity, each with its standard deviation under the part's own noise and drift.
 *
 * A program that does not name these functions does not link them. No heap; the caller owns the memory:
 * SELFCAL_TUMBLE_MAX rests of 32 bytes, selfcal_tumble_work_t and selfcal_tumble_t, 6 KB together for 24 rests.
 *
 *     static selfcal_tumble_rest_t rests[SELFCAL_TUMBLE_MAX];
 *     static selfcal_tumble_work_t work;
 *     static selfcal_tumble_t found;
 *     // at each rest, as the gate finds it: the mean of 10 s or more, and its time
 *     rests[count] = (selfcal_tumble_rest_t){{ax, ay, az, gx, gy, gz}, begin_s, end_s};
 *     // at the end, at rest and not between samples: it runs to its end
 *     if (selfcal_tumble(&found, &part, rests, count, &work) == SELFCAL_TUMBLE_OK) {
 *         selfcal_tumble_apply(&found, reading, corrected);
 *     }
 *
 * Model:  f = T K (a - b),  |f| = gravity at rest;  T unit upper triangular (z keeps its axis), K diagonal.
 *         y = b + G f + the Earth's rate at rest.
 * The sign of f is not seen by |f|: where a side that points up reads -1 g, take all three readings times -1.
 * A rest is a mean: N^2 / length, and the drift since the end of the last rest, where the bias is to be known. A square
 * of the scale, 5e-5 s^2/m (sd), is in the intervals. The fit is Gauss-Newton on |f| - gravity, weighted by the inverse
 * of that covariance. Its priors, in sd: bias 0.98 m/s^2 and 10 deg/s, scale 2 %, angle 20 mrad, g-sensitivity 0.1
 * deg/s/g. A parameter is identified if the data, with priors eight times as wide, leave 0.2 of its prior variance at
 * most. Six flats within a degree identify bias and scale; an edge in each plane adds the angles. Three rests, or equal
 * positions, may identify the gyros' bias alone. A wrong gravity goes into the scales: no rest shows it.
 *
 * Units: m/s^2, rad/s, s, rad, rad/s per m/s^2. The arithmetic is in selfcal_wide_t: weights of a drift that is large
 * against the noise lose float's digits. Results are right to 1e-4 of their standard deviation.
 * Cortex-M4F: 5.9 KB of flash beside the software doubles, 1.2 KB of stack; 10 million instructions of 12 rests, 36 of
 * 24, 105 with a Gauss-Markov drift. It fits a Cortex-M0 too.
 * On a module selfcal_imu_tumble_start() and _stop() do all of it, see below.
 * The gyros' scale and misalignment take the turns between the rests: `selfcal tumble` on the host. */
#ifndef SELFCAL_TUMBLE_H
#define SELFCAL_TUMBLE_H

#include <stdbool.h>
#include <stdint.h>

#include "selfcal.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Rests of one calibration at most. 4 MAX^2 + 140 MAX bytes of work and rests, about. */
#ifndef SELFCAL_TUMBLE_MAX
#define SELFCAL_TUMBLE_MAX 24
#endif

enum { SELFCAL_TUMBLE_ACCEL = 9, SELFCAL_TUMBLE_GYRO = 4 };

/* The priors; `selfcal tumble` on the host takes them from here. sd of the accelerometers' bias, m/s^2 (100 mg), scale
 * and angle, rad; of the square of the scale, s^2/m: 0.5 mg at 1 g. Data sheets' 0.1 to 0.5 % of a range of 2 to 16 g
 * are 0.1 to 1. */
#define SELFCAL_TUMBLE_BIAS_SD 0.98
#define SELFCAL_TUMBLE_SCALE_SD 0.02
#define SELFCAL_TUMBLE_ANGLE_SD 0.02
#define SELFCAL_TUMBLE_SQUARE_SD 5e-5
/* A parameter beyond so many sd of its prior is none of an accelerometer. */
#define SELFCAL_TUMBLE_REACH 10.0
/* An identified parameter keeps this part of its prior variance at most, were every prior so many times as wide. */
#define SELFCAL_TUMBLE_LEFT 0.2
#define SELFCAL_TUMBLE_WIDER 8.0

/* Why there is no result. */
typedef enum {
    SELFCAL_TUMBLE_OK = 0,
    SELFCAL_TUMBLE_BAD_ARGUMENT, /* a NULL, or more rests than SELFCAL_TUMBLE_MAX */
    SELFCAL_TUMBLE_TOO_FEW,      /* fewer than three rests */
    SELFCAL_TUMBLE_BAD_PART,     /* gravity, a noise or a drift that is none */
    SELFCAL_TUMBLE_BAD_REST,     /* a mean that is no number, or times that are not in order */
    SELFCAL_TUMBLE_NOTHING,      /* no parameter is identified; of a pipe, fewer than before: that result stays */
    SELFCAL_TUMBLE_UNSETTLED /* the fit does not settle, or 10 sd off its priors: readings of another unit, no rests */
} selfcal_tumble_status_t;

/* Noise and drift of an axis: white density N, walk density K, Gauss-Markov deviation and bandwidth (0: none). */
typedef struct {
    float N, K, sigma_m, alpha;
} selfcal_tumble_noise_t;

/* The part and the place. `vertical`: the Earth's rate times the sine of the latitude; `level`: times its cosine over
 * sqrt(2), which stands in the intervals. Without a latitude 0 and 4.2e-5 rad/s, and G has an error of 5e-6. */
typedef struct {
    selfcal_tumble_noise_t noise[6]; /* ax, ay, az, gx, gy, gz */
    float gravity, vertical, level;
} selfcal_tumble_part_t;

/* Means of a rest from `begin_s` to `end_s`, in order ax, ay, az, gx, gy, gz. Rests are in order of time. */
typedef struct {
    float mean[6];
    float begin_s, end_s;
} selfcal_tumble_rest_t;

/* The result. Order of accelerometer parameters: bias x y z, scale less 1 x y z, angles xy xz yz; of a gyro's: bias, G
 * of x y z. Covariances are lower triangles by rows. Values that are not identified are NAN in `accel` and `gyro`.
 * `bias` and `matrix` are what selfcal_tumble_apply() takes: the straight lines that come nearest at 1 g. There a
 * parameter that is not identified has its likeliest value, near 0 error. */
typedef struct {
    selfcal_wide_t accel[SELFCAL_TUMBLE_ACCEL], gyro[3][SELFCAL_TUMBLE_GYRO];
    float accel_covariance[45], gyro_covariance[3][10];
    float bias[3], matrix[3][3], gyro_bias[3], G[3][3];
    float ratio; /* rms of |f| - gravity in its own sd; NAN without a rest to spare. Above 2: a rest was none */
    uint16_t accel_identified, gyro_identified; /* a bit for each parameter; gyros 4 bits each */
} selfcal_tumble_t;

/* Not for users. */
typedef struct {
    selfcal_wide_t factor[SELFCAL_TUMBLE_MAX > 9 ? SELFCAL_TUMBLE_MAX *(SELFCAL_TUMBLE_MAX + 1) / 2 : 45];
    selfcal_wide_t column[SELFCAL_TUMBLE_ACCEL][SELFCAL_TUMBLE_MAX], residual[SELFCAL_TUMBLE_MAX];
} selfcal_tumble_work_t;

/* Calibrate by `count` rests. Any other status than OK leaves no number in `found`: all are NAN, no bit is set. */
selfcal_tumble_status_t selfcal_tumble(selfcal_tumble_t *found, const selfcal_tumble_part_t *part,
                                       const selfcal_tumble_rest_t rests[], uint8_t count, selfcal_tumble_work_t *work);

/* Standard deviation of an accelerometer parameter, 0 to 8, or of parameter `k` of a gyro; NAN if not identified. */
float selfcal_tumble_accel_sd(const selfcal_tumble_t *found, uint8_t k);
float selfcal_tumble_gyro_sd(const selfcal_tumble_t *found, uint8_t axis, uint8_t k);

/* Correct one reading of six axes. */
void selfcal_tumble_apply(const selfcal_tumble_t *found, const float reading[6], float corrected[6]);

/* What `count` sound rests, 0 to SELFCAL_TUMBLE_MAX, tell of the accelerometers: the covariance of the nine, as
 * accel_covariance, at error 0. Returns a bit for each parameter that they identify; 0, and no covariance, where there
 * is none. A round of the fit: 1 million instructions of 12 rests on a Cortex-M4F. */
uint16_t selfcal_tumble_known(const selfcal_tumble_part_t *part, const selfcal_tumble_rest_t rests[], uint8_t count,
                              selfcal_tumble_work_t *work, float found[45]);

/* --- on a module ---
 * A pipe that names selfcal_tumbling_code (`-DSELFCAL_MODEL_TUMBLED=1`) calibrates while it runs. Between start and
 * stop the gate tells rests, and the bank takes no sample. A rest counts from SELFCAL_TUMBLE_REST_S of whole windows
 * on. The result corrects samples (selfcal_imu_corrected()), and goes with the saved state (selfcal_imu_save()), which
 * SELFCAL_TUMBLE_SAVED bytes are added to. They have a checksum of their own: a restore takes them also where it
 * refuses the bank. */
#ifndef SELFCAL_TUMBLE_REST_S
#define SELFCAL_TUMBLE_REST_S 10
#endif

struct selfcal_tumbling {
    selfcal_tumble_part_t part;
    uint8_t axis[6];             /* of the model: ax ay az gx gy gz */
    float accel_unit, gyro_unit; /* the model's, in m/s^2 and rad/s */
};

/* Positions by the side that is up: +z +y +x -z -y -x, then edges: +x+y +x-y +x+z -x+z +y+z -y+z. */
enum { SELFCAL_TUMBLE_POSITIONS = 12 };

typedef enum {
    SELFCAL_TUMBLE_OFF = 0,
    SELFCAL_TUMBLE_PLACE = 1, /* no rest: place the part as `next` says */
    SELFCAL_TUMBLE_HOLD = 2,  /* a rest that does not count yet: leave the part alone */
    SELFCAL_TUMBLE_TURN = 3   /* a rest that counts: turn the part as `next` says */
} selfcal_tumble_phase_t;

typedef struct {
    selfcal_tumble_phase_t phase;
    selfcal_tumble_status_t status; /* of the last stop since power-on, or OK */
    uint8_t rests, wanted;          /* `wanted` goes beyond 12 while parameters are not identified */
    uint8_t next;                   /* position; SELFCAL_TUMBLE_POSITIONS: none, stop */
    bool applied;                   /* a calibration corrects samples */
} selfcal_tumble_progress_t;

/* The calibration in use, as it is saved. Units as above; it holds for readings without the sensor's own offsets
 * (selfcal_shifted()). Members as selfcal_tumble_t's, 0 for NAN: what is not identified has error 0. A
 * `ratio` above 1 widens the sd. */
typedef struct {
    float accel[SELFCAL_TUMBLE_ACCEL], covariance[45], G[9], ratio;
    uint16_t accel_identified, gyro_identified;
} selfcal_tumbled_t;

#define SELFCAL_TUMBLE_SAVED (sizeof(selfcal_tumbled_t) + 8U)

/* Begin: earlier rests are forgotten, an earlier result stays. False: the pipe names no calibration, the gate is off,
 * or an axis is retired. */
bool selfcal_imu_tumble_start(selfcal_imu_t *imu);

/* End, and calibrate by the rests. Any other status than OK leaves the result before. It takes as long as
 * selfcal_tumble(). */
selfcal_tumble_status_t selfcal_imu_tumble_stop(selfcal_imu_t *imu);

/* How far it is. `next` is the position whose residual is least known after the rests so far, by their information.
 * After a rest that counts it takes as long as selfcal_tumble_known(). The pipe names a calibration. */
const selfcal_tumble_progress_t *selfcal_imu_tumble_progress(selfcal_imu_t *imu);

/* Values of message TUMBLE for selfcal_telemetry_words(): the progress, and of the calibration in use the parameters
 * that are identified, with their sd. `there`: which, a bit each. They stay until the next call of these functions. */
enum { SELFCAL_TUMBLE_WORDS = 29 };
const uint32_t *selfcal_imu_tumble_words(selfcal_imu_t *imu, uint32_t *there);

/* The calibration in use; NULL: none. */
const selfcal_tumbled_t *selfcal_imu_tumbled(const selfcal_imu_t *imu);

/* Private; declared here so that the caller can place it. */
struct selfcal_imu_tumble {
    selfcal_tumbled_t used;
    selfcal_tumble_progress_t progress;
    bool resting, counted, due;    /* at rest since a window began; the rest counts; `next` is to be worked out */
    uint8_t ended;                 /* rests that count and have ended */
    uint32_t passed, window, kept; /* samples since the start, of the window and of the rest under way */
    uint32_t faults;               /* readings that the bank found wrong, when the window began */
    selfcal_tumble_rest_t rest[SELFCAL_TUMBLE_MAX];
    selfcal_tumble_t found;
    union {
        selfcal_tumble_work_t work;
        uint32_t word[SELFCAL_TUMBLE_WORDS];
    } by;
};

#ifdef __cplusplus
}
#endif

#endif
