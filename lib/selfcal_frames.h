/* The telemetry frame format in numbers. Generated from selfcal.dbc, which describes every item:
 * python -m selfcal.frames_codegen. Do not edit. */
#ifndef SELFCAL_FRAMES_H
#define SELFCAL_FRAMES_H

#define SELFCAL_FRAMES_VERSION 1U

/* First bit and width of what every frame carries, in its 8 bytes read as one little-endian number; the
 * value of the item is in bits 0 to 31. */
#define SELFCAL_FRAME_ITEM_SHIFT 32U
#define SELFCAL_FRAME_ITEM_MASK 0x3FU
#define SELFCAL_FRAME_COUNTER_SHIFT 38U
#define SELFCAL_FRAME_COUNTER_MASK 0x3FU
#define SELFCAL_FRAME_TIME_SHIFT 44U
#define SELFCAL_FRAME_TIME_MASK 0xFFU
#define SELFCAL_FRAME_CRC_SHIFT 52U
#define SELFCAL_FRAME_CRC_MASK 0xFFFU

#define SELFCAL_FRAME_STATUS_ID 0x200U

/* Axis name and id of each axis message. */
#define SELFCAL_FRAME_AXES 6U
#define SELFCAL_FRAME_AXIS_TABLE \
    { \
        {"gx", 0x201U}, \
        {"gy", 0x202U}, \
        {"gz", 0x203U}, \
        {"ax", 0x204U}, \
        {"ay", 0x205U}, \
        {"az", 0x206U}, \
    }

/* Items of an axis message; units of a gyro axis, those of an accelerometer are alike in m/s^2. */
enum {
    SELFCAL_AXIS_TIME_MS = 0, /* uint32, ms */
    SELFCAL_AXIS_COUNT = 1, /* uint32 */
    SELFCAL_AXIS_NOT_FINITE = 2, /* uint1, bit 0 */
    SELFCAL_AXIS_SATURATED = 2, /* uint1, bit 1 */
    SELFCAL_AXIS_STUCK = 2, /* uint1, bit 2 */
    SELFCAL_AXIS_GAPS = 2, /* uint1, bit 3 */
    SELFCAL_AXIS_BLOCKS_LOST = 2, /* uint1, bit 4 */
    SELFCAL_AXIS_LN_EVIDENCE = 3, /* float32, nat */
    SELFCAL_AXIS_BIAS_MEAN = 4, /* float32, deg/s */
    SELFCAL_AXIS_BIAS_SD = 5, /* float32, deg/s */
    SELFCAL_AXIS_CONSTANT_PROBABILITY = 6, /* float32 */
    SELFCAL_AXIS_RANDOM_WALK_PROBABILITY = 7, /* float32 */
    SELFCAL_AXIS_GAUSS_MARKOV_PROBABILITY = 8, /* float32 */
    SELFCAL_AXIS_CONSTANT_LN_EVIDENCE_DIFF = 9, /* int32 x 0.001, nat */
    SELFCAL_AXIS_RANDOM_WALK_LN_EVIDENCE_DIFF = 10, /* int32 x 0.001, nat */
    SELFCAL_AXIS_GAUSS_MARKOV_LN_EVIDENCE_DIFF = 11, /* int32 x 0.001, nat */
    SELFCAL_AXIS_CONSTANT_N_FLAGS = 12, /* uint4, bits 0 to 3 */
    SELFCAL_AXIS_RANDOM_WALK_N_FLAGS = 12, /* uint4, bits 4 to 7 */
    SELFCAL_AXIS_RANDOM_WALK_K_FLAGS = 12, /* uint4, bits 8 to 11 */
    SELFCAL_AXIS_GAUSS_MARKOV_N_FLAGS = 12, /* uint4, bits 12 to 15 */
    SELFCAL_AXIS_GAUSS_MARKOV_SIGMA_M_FLAGS = 12, /* uint4, bits 16 to 19 */
    SELFCAL_AXIS_GAUSS_MARKOV_ALPHA_FLAGS = 12, /* uint4, bits 20 to 23 */
    SELFCAL_AXIS_CONSTANT_N_MEAN = 13, /* float32, deg/s/sqrt(Hz) */
    SELFCAL_AXIS_CONSTANT_N_MEDIAN = 14, /* float32, deg/s/sqrt(Hz) */
    SELFCAL_AXIS_CONSTANT_N_SD = 15, /* float32, deg/s/sqrt(Hz) */
    SELFCAL_AXIS_CONSTANT_N_Q05 = 16, /* float32, deg/s/sqrt(Hz) */
    SELFCAL_AXIS_CONSTANT_N_Q95 = 17, /* float32, deg/s/sqrt(Hz) */
    SELFCAL_AXIS_RANDOM_WALK_N_MEAN = 18, /* float32, deg/s/sqrt(Hz) */
    SELFCAL_AXIS_RANDOM_WALK_N_MEDIAN = 19, /* float32, deg/s/sqrt(Hz) */
    SELFCAL_AXIS_RANDOM_WALK_N_SD = 20, /* float32, deg/s/sqrt(Hz) */
    SELFCAL_AXIS_RANDOM_WALK_N_Q05 = 21, /* float32, deg/s/sqrt(Hz) */
    SELFCAL_AXIS_RANDOM_WALK_N_Q95 = 22, /* float32, deg/s/sqrt(Hz) */
    SELFCAL_AXIS_RANDOM_WALK_K_MEAN = 23, /* float32, deg/s^2/sqrt(Hz) */
    SELFCAL_AXIS_RANDOM_WALK_K_MEDIAN = 24, /* float32, deg/s^2/sqrt(Hz) */
    SELFCAL_AXIS_RANDOM_WALK_K_SD = 25, /* float32, deg/s^2/sqrt(Hz) */
    SELFCAL_AXIS_RANDOM_WALK_K_Q05 = 26, /* float32, deg/s^2/sqrt(Hz) */
    SELFCAL_AXIS_RANDOM_WALK_K_Q95 = 27, /* float32, deg/s^2/sqrt(Hz) */
    SELFCAL_AXIS_GAUSS_MARKOV_N_MEAN = 28, /* float32, deg/s/sqrt(Hz) */
    SELFCAL_AXIS_GAUSS_MARKOV_N_MEDIAN = 29, /* float32, deg/s/sqrt(Hz) */
    SELFCAL_AXIS_GAUSS_MARKOV_N_SD = 30, /* float32, deg/s/sqrt(Hz) */
    SELFCAL_AXIS_GAUSS_MARKOV_N_Q05 = 31, /* float32, deg/s/sqrt(Hz) */
    SELFCAL_AXIS_GAUSS_MARKOV_N_Q95 = 32, /* float32, deg/s/sqrt(Hz) */
    SELFCAL_AXIS_GAUSS_MARKOV_SIGMA_M_MEAN = 33, /* float32, deg/s */
    SELFCAL_AXIS_GAUSS_MARKOV_SIGMA_M_MEDIAN = 34, /* float32, deg/s */
    SELFCAL_AXIS_GAUSS_MARKOV_SIGMA_M_SD = 35, /* float32, deg/s */
    SELFCAL_AXIS_GAUSS_MARKOV_SIGMA_M_Q05 = 36, /* float32, deg/s */
    SELFCAL_AXIS_GAUSS_MARKOV_SIGMA_M_Q95 = 37, /* float32, deg/s */
    SELFCAL_AXIS_GAUSS_MARKOV_ALPHA_MEAN = 38, /* float32, 1/s */
    SELFCAL_AXIS_GAUSS_MARKOV_ALPHA_MEDIAN = 39, /* float32, 1/s */
    SELFCAL_AXIS_GAUSS_MARKOV_ALPHA_SD = 40, /* float32, 1/s */
    SELFCAL_AXIS_GAUSS_MARKOV_ALPHA_Q05 = 41, /* float32, 1/s */
    SELFCAL_AXIS_GAUSS_MARKOV_ALPHA_Q95 = 42, /* float32, 1/s */
    SELFCAL_AXIS_END_TIME_MS = 43, /* uint24, bits 0 to 23, ms */
    SELFCAL_AXIS_END_ITEMS = 43, /* uint8, bits 24 to 31 */
};

#define SELFCAL_AXIS_NOT_FINITE_SHIFT 0U
#define SELFCAL_AXIS_NOT_FINITE_MASK 0x1U
#define SELFCAL_AXIS_SATURATED_SHIFT 1U
#define SELFCAL_AXIS_SATURATED_MASK 0x1U
#define SELFCAL_AXIS_STUCK_SHIFT 2U
#define SELFCAL_AXIS_STUCK_MASK 0x1U
#define SELFCAL_AXIS_GAPS_SHIFT 3U
#define SELFCAL_AXIS_GAPS_MASK 0x1U
#define SELFCAL_AXIS_BLOCKS_LOST_SHIFT 4U
#define SELFCAL_AXIS_BLOCKS_LOST_MASK 0x1U
#define SELFCAL_AXIS_CONSTANT_LN_EVIDENCE_DIFF_PER_UNIT 1000.0
#define SELFCAL_AXIS_RANDOM_WALK_LN_EVIDENCE_DIFF_PER_UNIT 1000.0
#define SELFCAL_AXIS_GAUSS_MARKOV_LN_EVIDENCE_DIFF_PER_UNIT 1000.0
#define SELFCAL_AXIS_CONSTANT_N_FLAGS_SHIFT 0U
#define SELFCAL_AXIS_CONSTANT_N_FLAGS_MASK 0xFU
#define SELFCAL_AXIS_RANDOM_WALK_N_FLAGS_SHIFT 4U
#define SELFCAL_AXIS_RANDOM_WALK_N_FLAGS_MASK 0xFU
#define SELFCAL_AXIS_RANDOM_WALK_K_FLAGS_SHIFT 8U
#define SELFCAL_AXIS_RANDOM_WALK_K_FLAGS_MASK 0xFU
#define SELFCAL_AXIS_GAUSS_MARKOV_N_FLAGS_SHIFT 12U
#define SELFCAL_AXIS_GAUSS_MARKOV_N_FLAGS_MASK 0xFU
#define SELFCAL_AXIS_GAUSS_MARKOV_SIGMA_M_FLAGS_SHIFT 16U
#define SELFCAL_AXIS_GAUSS_MARKOV_SIGMA_M_FLAGS_MASK 0xFU
#define SELFCAL_AXIS_GAUSS_MARKOV_ALPHA_FLAGS_SHIFT 20U
#define SELFCAL_AXIS_GAUSS_MARKOV_ALPHA_FLAGS_MASK 0xFU
#define SELFCAL_AXIS_END_TIME_MS_SHIFT 0U
#define SELFCAL_AXIS_END_TIME_MS_MASK 0xFFFFFFU
#define SELFCAL_AXIS_END_ITEMS_SHIFT 24U
#define SELFCAL_AXIS_END_ITEMS_MASK 0xFFU

/* Items of the status message. */
enum {
    SELFCAL_STATUS_TIME_MS = 0, /* uint32, ms */
    SELFCAL_STATUS_WIRE_VERSION = 1, /* uint32 */
    SELFCAL_STATUS_MODEL_ID = 2, /* uint32 */
    SELFCAL_STATUS_BANK_INTERVAL = 3, /* float32, s */
    SELFCAL_STATUS_BANK_BLOCK = 4, /* uint32 */
    SELFCAL_STATUS_STATE = 5, /* uint32 */
    SELFCAL_STATUS_REPORT = 6, /* uint32 */
    SELFCAL_STATUS_SAMPLES = 7, /* uint32 */
    SELFCAL_STATUS_MISSING = 8, /* uint32 */
    SELFCAL_STATUS_GAP_COUNT = 9, /* uint32 */
    SELFCAL_STATUS_BLOCKS_LOST_COUNT = 10, /* uint32 */
    SELFCAL_STATUS_BLOCKS_PART_COUNT = 11, /* uint32 */
    SELFCAL_STATUS_NOT_FINITE_COUNT = 12, /* uint32 */
    SELFCAL_STATUS_SATURATED_COUNT = 13, /* uint32 */
    SELFCAL_STATUS_STUCK_COUNT = 14, /* uint32 */
    SELFCAL_STATUS_FRAMES_SENT = 15, /* uint32 */
};


#define SELFCAL_STATUS_STATE_RUNNING 1U
#define SELFCAL_STATUS_STATE_FINISHED 2U

#endif
