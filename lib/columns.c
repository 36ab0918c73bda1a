/* The values of regressors, formed from raw channels sample by sample. Host and module run this code.
 *
 * A window of W samples is held in SELFCAL_COLUMN_BINS bins of S = ceil(W / SELFCAL_COLUMN_BINS) samples,
 * and one bin more. So the memory does not grow with W.
 * Mean over the window: the oldest bin counts by the part of it that lies within the window.
 * Gain over the window: the value W samples ago lies on the line between the two bin ends beside it.
 * Slope over the window: the line that fits the means of the bins best, weighed by their samples in the window.
 * Lag: x += g (v - x) at each sample, g = 1 - exp(-interval / time constant). Kept is x - v, in two floats.
 * Phase of a line: a product of integers modulo 2^64, which does not drift. */
#include "bank_inside.h"

#define BINS (SELFCAL_COLUMN_BINS + 2U)
#define TWO_PI R(6.283185307179586)

static selfcal_wide_t interval_of(const selfcal_model_t *model) {
    return (selfcal_wide_t)model->dt_s / (selfcal_wide_t)model->block;
}

/* Window that a column's channel is held in, s; 0: none. */
static float window_of(const selfcal_source_t *source) {
    switch (source->kind) {
    case SELFCAL_COLUMN_CHANNEL:
    case SELFCAL_COLUMN_RATE:
    case SELFCAL_COLUMN_SLOPE: return source->number;
    case SELFCAL_COLUMN_LAG:
    case SELFCAL_COLUMN_SQUARE:
    case SELFCAL_COLUMN_CUBE: return source->second;
    default: return 0.0F;
    }
}

/* How a column's window is cut: samples of it, and of a bin. */
typedef struct {
    uint32_t window, bin;
} cut_t;

static cut_t cut_of(const selfcal_former_t *self, const selfcal_source_t *source) {
    const selfcal_wide_t samples = floor((selfcal_wide_t)window_of(source) / interval_of(self->model) + 0.5);
    const uint32_t least = source->kind == SELFCAL_COLUMN_SLOPE ? 2U : 1U;
    cut_t cut = {samples > (selfcal_wide_t)least ? (uint32_t)fmin(samples, 4e9) : least, 1U};
    cut.bin = (cut.window + SELFCAL_COLUMN_BINS - 1U) / SELFCAL_COLUMN_BINS;
    return cut;
}

static bool has_window(const selfcal_source_t *source) {
    return window_of(source) > 0.0F;
}

static bool is_positive(float number) {
    return number > 0.0F && isfinite(number);
}

static bool is_time(float number) {
    return number >= 0.0F && isfinite(number);
}

static bool valid_source(const selfcal_source_t *source) {
    switch (source->kind) {
    case SELFCAL_COLUMN_TIME: return true;
    case SELFCAL_COLUMN_CHANNEL:
    case SELFCAL_COLUMN_STEP: return is_time(source->number);
    case SELFCAL_COLUMN_RATE:
    case SELFCAL_COLUMN_SLOPE:
    case SELFCAL_COLUMN_SINE:
    case SELFCAL_COLUMN_COSINE:
    case SELFCAL_COLUMN_TURN_ON: return is_positive(source->number);
    case SELFCAL_COLUMN_PULSE:
        return is_time(source->number) && source->second > source->number && isfinite(source->second);
    case SELFCAL_COLUMN_LAG: return is_positive(source->number) && is_time(source->second);
    case SELFCAL_COLUMN_SQUARE:
    case SELFCAL_COLUMN_CUBE: return isfinite(source->number) && is_time(source->second);
    default: return false;
    }
}

/* The first sample at a time or after it. */
static uint64_t sample_of(const selfcal_former_t *self, float time_s) {
    return (uint64_t)fmin(ceil((selfcal_wide_t)time_s / interval_of(self->model) - 1e-3), 1e18);
}

selfcal_status_t selfcal_former_init(selfcal_former_t *self, const selfcal_model_t *model) {
    if (self == NULL || model == NULL || model->regressors == NULL || model->regressors->source == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    memset(self, 0, sizeof *self);
    self->model = model;
    const selfcal_regressors_t *regressors = model->regressors;
    if (regressors->count > SELFCAL_REGRESSORS_MAX || model->block == 0U || !(model->dt_s > 0.0F)) {
        return SELFCAL_BAD_MODEL;
    }
    for (uint8_t k = 0; k < regressors->count; k++) {
        const selfcal_source_t *source = &regressors->source[k];
        if (!valid_source(source)) {
            return SELFCAL_BAD_MODEL;
        }
        selfcal_trail_t *trail = &self->trail[k];
        trail->first = trail->last = NAN; /* no value of the channel yet */
        if (has_window(source)) {
            const cut_t cut = cut_of(self, source);
            trail->window = cut.window;
            trail->bin = cut.bin;
        }
        if (source->kind == SELFCAL_COLUMN_LAG) {
            trail->gain = -r_expm1(-(selfcal_real_t)(interval_of(model) / (selfcal_wide_t)source->number));
            trail->state.hi = (selfcal_real_t)NAN; /* no value to go on from */
        } else if (source->kind == SELFCAL_COLUMN_STEP || source->kind == SELFCAL_COLUMN_PULSE) {
            trail->step = sample_of(self, source->number);
            if (source->kind == SELFCAL_COLUMN_PULSE) {
                trail->window = (uint32_t)fmin((selfcal_wide_t)(sample_of(self, source->second) - trail->step), 4e9);
            }
        } else if (source->kind == SELFCAL_COLUMN_SINE || source->kind == SELFCAL_COLUMN_COSINE) {
            const selfcal_wide_t turns = (selfcal_wide_t)source->number * interval_of(model); /* a sample */
            trail->step = (uint64_t)((turns - floor(turns)) * 18446744073709551616.0);
        }
    }
    return SELFCAL_OK;
}

selfcal_status_t selfcal_former_resume(selfcal_former_t *self, const selfcal_t *bank) {
    if (bank == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    const selfcal_status_t status = selfcal_former_init(self, bank->model);
    if (status != SELFCAL_OK) {
        return status;
    }
    self->samples = bank->counters.samples + bank->counters.missing;
    self->powered = bank->powered;
    for (uint8_t k = 0; k < bank->model->regressors->count && bank->n > 0U; k++) {
        if (bank->model->regressors->source[k].kind == SELFCAL_COLUMN_LAG) {
            self->trail[k].state = make_sum((selfcal_wide_t)selfcal_regressor_last(bank, k));
        }
    }
    return SELFCAL_OK;
}

selfcal_status_t selfcal_power_on(selfcal_t *self, uint64_t samples) {
    if (self == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    self->powered = samples - (self->counters.samples + self->counters.missing);
    return SELFCAL_OK;
}

float selfcal_regressor_last(const selfcal_t *self, uint8_t k) {
    const selfcal_column_t *column = &self->columns->column[k];
    return (float)(column->last + column->offset + (selfcal_real_t)column->origin);
}

/* The bin `back` before the newest whole one. */
static float bin_at(const selfcal_trail_t *trail, uint32_t back) {
    return trail->ring[(trail->bins - 1U - back) % BINS];
}

static void close_bin(selfcal_trail_t *trail, float value) {
    trail->ring[trail->bins % BINS] = value;
    trail->bins++;
    if (trail->bins == 2U * BINS) { /* so that it never wraps: only its place in the ring counts from here on */
        trail->bins = BINS;
    }
    trail->in_bin = 0;
    trail->sum = 0.0F;
}

/* Mean of the last samples, a window of them or fewer at the beginning; all are taken about the first one. */
static float trailing_mean(selfcal_trail_t *trail, float value) {
    if (isnan(trail->first)) {
        trail->first = value;
    }
    trail->sum += value - trail->first;
    trail->in_bin++;
    float sum = trail->sum;
    uint32_t count = trail->in_bin;
    for (uint32_t back = 0; back < trail->bins && back < BINS && count < trail->window; back++) {
        const uint32_t room = trail->window - count, taken = room < trail->bin ? room : trail->bin;
        sum += bin_at(trail, back) * ((float)taken / (float)trail->bin);
        count += taken;
    }
    if (trail->in_bin == trail->bin) {
        close_bin(trail, trail->sum);
    }
    return trail->first + sum / (float)count;
}

/* The channel at a bin's end within a step from `last` to `value`, `ahead` of `stride` samples after `last`. */
static float between(float last, float value, uint64_t ahead, uint64_t stride) {
    return last + (value - last) * ((float)ahead / (float)stride);
}

/* What the channel gained over the last window; over a shorter time, at the beginning, from its first value. */
static float gained(selfcal_trail_t *trail, float value, uint64_t stride) {
    if (isnan(trail->first)) {
        trail->first = trail->last = value;
        close_bin(trail, value); /* the ring holds the values at bin ends, in_bin counts samples since the newest */
        return 0.0F;
    }
    const uint64_t bin = trail->bin, most = (uint64_t)BINS * bin;
    uint64_t ahead = bin - trail->in_bin;         /* samples from the last one to the next bin end */
    if (stride > most && ahead + most < stride) { /* a long gap: older ends leave the ring anyway */
        ahead += (stride - most - ahead) / bin * bin;
    }
    for (; ahead <= stride; ahead += bin) {
        close_bin(trail, between(trail->last, value, ahead, stride));
    }
    trail->in_bin = (uint32_t)(bin - (ahead - stride));
    trail->last = value;
    /* The window's beginning lies `back` samples before the newest bin end. */
    const uint32_t back = trail->window - (trail->in_bin < trail->window ? trail->in_bin : trail->window);
    const uint32_t whole = back / trail->bin, part = back % trail->bin;
    if (whole + (part > 0U ? 1U : 0U) >= trail->bins) {
        return value - trail->first;
    }
    const float newer = bin_at(trail, whole);
    const float older = part > 0U ? bin_at(trail, whole + 1U) : newer;
    return value - (newer + (older - newer) * ((float)part / (float)trail->bin));
}

/* Adds `stride` samples on a straight line, the newest `value`, to the bins: sums about the first value. */
static void fill_bins(selfcal_trail_t *trail, float value, uint32_t stride) {
    const float slope = (value - trail->last) / (float)stride, start = trail->last - trail->first;
    for (uint32_t done = 0; done < stride;) {
        const uint32_t room = trail->bin - trail->in_bin, left = stride - done, taken = room < left ? room : left;
        const float middle = (float)done + 0.5F * (float)(taken + 1U);
        trail->sum += (float)taken * (taken == 1U && left == 1U ? value - trail->first : start + slope * middle);
        trail->in_bin += taken;
        done += taken;
        if (trail->in_bin == trail->bin) {
            close_bin(trail, trail->sum);
        }
    }
}

/* Slope, per sample, of the line that fits the window best. A gap as long as the window begins it anew: at rest. */
static float slope_of(selfcal_trail_t *trail, float value, uint64_t stride) {
    if (isnan(trail->first) || stride > trail->window) {
        trail->first = trail->last = value;
        memset(trail->ring, 0, sizeof trail->ring);
        trail->bins = BINS;
        trail->in_bin = 0;
        trail->sum = 0.0F;
        stride = 1;
    }
    fill_bins(trail, value, (uint32_t)stride);
    trail->last = value;
    /* Each bin's age is that of its middle, less half the window. Its mean is taken about the newest value. */
    const float half = 0.5F * (float)(trail->window - 1U), size = (float)trail->bin, about = value - trail->first;
    float count = (float)trail->in_bin, age = 0.5F * (count - 1.0F) - half;
    float mean = count > 0.0F ? trail->sum / count - about : 0.0F;
    float n = 0.0F, a = 0.0F, aa = 0.0F, y = 0.0F, ay = 0.0F; /* sums over the bins */
    for (uint32_t back = 0; back < BINS; back++) {
        n += count;
        a += count * age;
        aa += count * age * age;
        y += count * mean;
        ay += count * age * mean;
        const float left = (float)trail->window - n;
        if (!(left > 0.0F)) {
            break;
        }
        age = (float)trail->in_bin + ((float)back + 0.5F) * size - 0.5F - half;
        mean = bin_at(trail, back) / size - about;
        count = left < size ? left : size;
    }
    return -(ay - a * y / n) / (aa - a * a / n);
}

/* A first-order low pass of the channel, at rest at its first value. */
static float lagging(selfcal_trail_t *trail, float value, float seconds, selfcal_real_t passed_s, uint64_t stride) {
    const selfcal_real_t gain = trail->gain;
    const selfcal_real_t gone = stride == 1U ? gain : -r_expm1(-passed_s / (selfcal_real_t)seconds);
    if (isnan(trail->last)) {
        if (isnan(trail->state.hi)) {
            trail->state = make_sum(0.0);
        } else { /* it goes on from a lag of which the channel's value is not known: taken as this one ever since */
            sum_add_value(&trail->state, -(selfcal_real_t)value);
            sum_add_value(&trail->state, -gone * trail->state.hi);
        }
    } else { /* on a line of `step` a sample the low pass ends up (1 - gain) / gain steps behind */
        const selfcal_real_t step = (selfcal_real_t)(value - trail->last) / (selfcal_real_t)stride;
        const selfcal_real_t decay = -gone * trail->state.hi;
        sum_add_value(&trail->state, decay);
        sum_add_value(&trail->state, -step * (R(1.0) - gain) * (gone / gain));
    }
    trail->last = value;
    return (float)((selfcal_real_t)value + trail->state.hi);
}

static float wave(uint64_t phase, bool cosine) {
    const selfcal_real_t turns = (selfcal_real_t)(phase >> 40) * (selfcal_real_t)(1.0 / 16777216.0);
    const selfcal_real_t angle = TWO_PI * turns;
    return (float)(cosine ? r_cos(angle) : r_sin(angle));
}

static bool has_channel(selfcal_column_kind_t kind) {
    return kind == SELFCAL_COLUMN_CHANNEL || kind == SELFCAL_COLUMN_RATE || kind >= SELFCAL_COLUMN_LAG;
}

/* The reading or channel that a column takes; 0 for a column of time alone. */
static float reading_of(const selfcal_source_t *source, const selfcal_model_t *model, const float sample[],
                        const float channels[]) {
    if (!has_channel(source->kind)) {
        return 0.0F;
    }
    return source->channel < model->axes ? sample[source->channel] : channels[source->channel - model->axes];
}

/* A column of a channel from its newest value, which is finite. */
static float from_channel(selfcal_trail_t *trail, const selfcal_source_t *source, float value, selfcal_wide_t interval,
                          uint64_t stride) {
    if (source->kind == SELFCAL_COLUMN_RATE) {
        return gained(trail, value, stride) / source->number;
    }
    if (source->kind == SELFCAL_COLUMN_SLOPE) {
        return slope_of(trail, value, stride) / (float)interval;
    }
    const float mean = has_window(source) ? trailing_mean(trail, value) : value, about = mean - source->number;
    switch (source->kind) {
    case SELFCAL_COLUMN_LAG:
        return lagging(trail, mean, source->number, (selfcal_real_t)((selfcal_wide_t)stride * interval), stride);
    case SELFCAL_COLUMN_SQUARE: return about * about;
    case SELFCAL_COLUMN_CUBE: return about * about * about;
    default: return mean;
    }
}

void selfcal_form(selfcal_former_t *self, uint32_t missing, const float sample[], const float channels[],
                  float values[]) {
    const selfcal_model_t *model = self->model;
    const selfcal_wide_t interval = interval_of(model);
    const uint64_t stride = (uint64_t)missing + 1U;
    self->samples += self->begun ? stride : missing;
    self->begun = true;
    for (uint8_t k = 0; k < model->regressors->count; k++) {
        const selfcal_source_t *source = &model->regressors->source[k];
        selfcal_trail_t *trail = &self->trail[k];
        const float raw = reading_of(source, model, sample, channels);
        switch (source->kind) {
        case SELFCAL_COLUMN_TIME: values[k] = (float)((selfcal_real_t)self->samples * (selfcal_real_t)interval); break;
        case SELFCAL_COLUMN_TURN_ON:
            values[k] = (float)r_exp(-(selfcal_real_t)(self->samples + self->powered) * (selfcal_real_t)interval /
                                     (selfcal_real_t)source->number);
            break;
        case SELFCAL_COLUMN_PULSE: /* before the pulse the difference wraps */
            values[k] = self->samples - trail->step < trail->window ? 1.0F : 0.0F;
            break;
        case SELFCAL_COLUMN_STEP: values[k] = self->samples >= trail->step ? 1.0F : 0.0F; break;
        case SELFCAL_COLUMN_SINE:
        case SELFCAL_COLUMN_COSINE:
            values[k] = wave(trail->step * self->samples, source->kind == SELFCAL_COLUMN_COSINE);
            break;
        default: values[k] = isfinite(raw) ? from_channel(trail, source, raw, interval, stride) : raw; break;
        }
    }
}

void selfcal_widest_coefficients(const selfcal_report_t *report, const selfcal_model_t *model,
                                 const selfcal_coefficients_t coefficients[], float probability,
                                 selfcal_sent_coefficient_t sent[]) {
    for (uint8_t k = 0; k < model->regressors->count; k++) {
        sent[k].mean = NAN;
        sent[k].sd = NAN;
        for (uint8_t h = 0; h < model->hypotheses; h++) {
            const float mean = coefficients[h].mean[k], sd = coefficients[h].sd[k];
            if (report->hypothesis[h].probability >= (float)SELFCAL_LIKELY && isfinite(mean) && !(sd <= sent[k].sd)) {
                sent[k].mean = mean;
                sent[k].sd = sd;
            }
        }
        sent[k].probability = probability;
    }
}
