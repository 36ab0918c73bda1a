/* A slow line in the innovations z of the adequacy's filters (adequacy.c): by its autocorrelation, tone by tone.
 *
 * A tone of frequency w remembers z for some m = 10/w samples:  e_t = lambda (e_(t-1) + z_(t-1)),  |lambda| = 1 - 1/m.
 * Its sum is that of z_t Re e_t, so of the autocorrelation at every lag k, weighted by (1 - 1/m)^k cos(w k). White z
 * give 0, with the variance n sum (1 - 1/m)^2k cos^2(w k). A line gives most to the tone nearest to it. Drift that the
 * law lacks is broad: of a score the mean of the tones two before and two after it is taken off.
 * The sum is about a gamma variable of n / 2m degrees, whose upper tail lies above that of the normal one of its
 * variance. P(s > x + x^2 / (2 sqrt(n / 2m))) is below e^(-x^2 / 2) (Laurent and Massart, 2000): x is the score.
 *
 * Six tones an octave. Each octave takes the sums of two samples of the one before over sqrt(2). Periods are 10 to 200
 * bank samples. A gap shifts the phase, so a line counts between gaps alone. z is held at TONE_HELD: outliers have no
 * tone. */
#include "bank_inside.h"

#define TONE_HELD R(4.0)
#define ROOT_HALF R(0.70710678)
enum { TONES = SELFCAL_TONES_OCTAVE * SELFCAL_TONES_OCTAVES, APART = 2 };

/* lambda; the variance of a term; m. w = pi/4 2^(-(k + 1/2) / 6) for the k-th. */
static const struct {
    selfcal_real_t re, im, spread, memory;
} tones[SELFCAL_TONES_OCTAVE] = {
    {R(0.68290172), R(0.62520182), R(2.7940389), R(13.489503)},
    {R(0.73756694), R(0.57294773), R(3.2096039), R(15.141455)},
    {R(0.78289473), R(0.52236102), R(3.6764682), R(16.995709)},
    {R(0.82034874), R(0.47427589), R(4.2008441), R(19.077038)},
    {R(0.85122315), R(0.4291852), R(4.7897206), R(21.413251)},
    {R(0.8766366), R(0.38733605), R(5.4509539), R(24.035562)},
};

void selfcal_tones_take(selfcal_tones_t *self, selfcal_real_t z) {
    selfcal_real_t x = r_fmin(r_fmax(z, -TONE_HELD), TONE_HELD);
    for (size_t octave = 0; octave < SELFCAL_TONES_OCTAVES; octave++) {
        for (size_t k = 0; k < SELFCAL_TONES_OCTAVE; k++) {
            selfcal_tone_t *tone = &self->tone[octave][k];
            tone->sum = r_fma(x, tone->re, tone->sum);
            const selfcal_real_t re = tone->re + x, im = tone->im;
            tone->re = tones[k].re * re - tones[k].im * im;
            tone->im = tones[k].im * re + tones[k].re * im;
        }
        if ((self->n >> octave & 1U) == 0U) { /* the first of two */
            self->half[octave] = x;
            break;
        }
        x = (x + self->half[octave]) * ROOT_HALF;
    }
    self->n++;
}

selfcal_real_t selfcal_tones_score(const selfcal_tones_t *self) {
    selfcal_real_t score[TONES], most = R(0.0);
    for (size_t i = 0; i < TONES; i++) {
        const size_t octave = i / SELFCAL_TONES_OCTAVE, k = i % SELFCAL_TONES_OCTAVE;
        const selfcal_real_t n = r_fmax((selfcal_real_t)(self->n >> octave), R(1.0));
        score[i] = self->tone[octave][k].sum / r_sqrt(n * tones[k].spread);
    }
    for (size_t i = APART; i < TONES - APART; i++) { /* the outer ones are there to be compared with */
        const selfcal_real_t broad = r_fmax(R(0.5) * (score[i - APART] + score[i + APART]), R(0.0));
        const selfcal_real_t n = (selfcal_real_t)(self->n >> (i / SELFCAL_TONES_OCTAVE)) + R(1.0);
        const selfcal_real_t root = r_sqrt(R(0.5) * n / tones[i % SELFCAL_TONES_OCTAVE].memory);
        const selfcal_real_t excess = r_fmax(score[i] - broad, R(0.0));
        most = r_fmax(most, root * (r_sqrt(R(1.0) + R(2.0) * excess / root) - R(1.0)));
    }
    return most;
}
