/* Expected variance of a filter's innovations: report_expected.c includes this once for each of its two types T. */

typedef struct {
    T v_less_1; /* the innovations' variance over sigma_v^2 of the data, less 1 */
    T s_less_1; /* what the filter itself takes it to be, over its own sigma_v^2, less 1 */
    T gain, p;  /* phi K; 1 - psi */
} NAME(expected_t);

/* The predicted drift variance that the filter of (rho^2, 1 - phi = beta) converges to, over its sigma_v^2. Of a random
 * walk beta is 0. */
static T NAME(settled)(T rho_sq, T beta) {
    const T one_less_phi_sq = beta * (T_(2.0) - beta);
    const T q = rho_sq * (beta > T_(0.0) ? one_less_phi_sq : T_(1.0));
    const T b = one_less_phi_sq - q;
    const T root = T_sqrt(b * b + T_(4.0) * q);
    return b > T_(0.0) ? T_(2.0) * q / (b + root) : T_(0.5) * (root - b);
}

/* That filter over white noise and a first-order drift of deviation sqrt(truth->variance) and pole 1 - truth->rate. Its
 * innovations are (1 - phi B)/(1 - psi B) y with psi = phi (1 - K), B the delay; their variance is that of an ARMA(2,1)
 * process, here written so that nothing cancels when the poles are close to 1. */
static NAME(expected_t) NAME(expected)(T rho_sq, T beta, const selfcal_truth_t *truth) {
    const T p_inf = NAME(settled)(rho_sq, beta);
    const T gain = (T_(1.0) - beta) * p_inf / (T_(1.0) + p_inf);
    const T p = gain + beta;
    const T c = (T)truth->rate;
    const T white_less_1 = gain * gain / (p * (T_(2.0) - p));
    const T drift = (beta * beta * (T_(1.0) + (T_(1.0) - p) * (T_(1.0) - c)) + T_(2.0) * (T_(1.0) - beta) * p * c) /
                    (p * (T_(2.0) - p) * (p + c - p * c));
    const NAME(expected_t) e = {(T)truth->variance * drift + white_less_1, p_inf, gain, p};
    return e;
}
