/* What the benches feed the library: a record, and the default model narrowed. */
#ifndef RECORD_H
#define RECORD_H

#include "selfcal.h"
#include "selfcal_model.h"

#include <stdbool.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct {
    uint32_t state;
} record_t;

void record_init(record_t *record);

/* The next sample: white noise about a bias as of an ADIS16405 at rest, averaged to 1 Hz; deg/s and m/s^2. */
void record_next(record_t *record, float sample[SELFCAL_MODEL_AXES]);

/* The default model with every sample a bank sample, one a second. */
selfcal_model_t record_model(void);

/* The same with priors narrowed to the fastest drifts, where every filter settles within hundreds of samples, or to the
 * slowest, where none does but the constant one. `axis` [axes] must stay. */
selfcal_model_t record_narrow_model(bool fast, selfcal_axis_t axis[SELFCAL_MODEL_AXES]);

/* Filters whose gains have settled for good: those that the fast kernel runs. */
unsigned record_settled(const selfcal_t *bank);

#ifdef __cplusplus
}
#endif

#endif
