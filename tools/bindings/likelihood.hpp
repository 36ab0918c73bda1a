// The likelihood of a record under any small state model: the diagnosis tries models here before the bank gets them.
//
// y_i = h x_i + sum_k c_k z_ik + v_i,  x_(i+1) = F x_i + w_i,  w ~ N(0, Q),  v_i ~ N(0, R r_i),  x_0 ~ N(0, P0).
// White noise with memory is a state: r then scales the noise of the state `driver` (-1: none) that enters at i.
// Readings that are block means have more noise where the block has lost readings: R r_i + lost (r_i - 1), at least a
// tenth of R r_i (lib/averages.h).
// One Kalman filter runs over the record and over every column z_k (de Jong 1991): with the whitened innovations
// nu_y and u_k, the Gram matrix G = sum [nu_y, u]' [nu_y, u] and D = sum ln s are all that the likelihood of any
// coefficients needs: the least squares estimate is c = G_uu^-1 G_uy.
#ifndef LIKELIHOOD_HPP
#define LIKELIHOOD_HPP

#include <cstddef>

namespace likelihood {

constexpr int states_max = 24;
constexpr int columns_max = 40;
// Parameters that derivatives are by, at most: one vector.
constexpr int width = 4;

// The matrices of a model, and their derivatives by each of `count` parameters, one after the other.
struct Matrices {
    const double *F, *Q, *h, *P0, *R, *lost;
};

struct Input {
    const double *y, *z, *r; // z: [p, n]
    std::size_t n;
    int columns; // 1 + p
    Matrices m, by;
    std::size_t states, count;
    int driver;
    const std::size_t *marks;
    std::size_t mark_count;
};

struct Sums {
    double *G;       // [marks, columns, columns]
    double *D;       // [marks]
    double *counted; // [marks] samples present
    double *x;       // [marks, columns, states] predicted states at each mark
    double *white;   // [n, columns] or null: whitened innovations, NaN where y is missing
    double *s;       // [n] or null: variance of each innovation
};

// Derivatives, by each parameter, of the sums over one column; and the sums of products that their information is.
struct Slopes {
    double *G, *D;                // [count]
    double *innovations, *spread; // [count, count]
};

// A shift of the level that begins at sample k and stays, at every k, by one pass backwards over the filter's gains
// (de Jong & Penzer 1998, JASA 93, 796). The shift is one state more, which F keeps and the filter does not know: with
// h = [h, 1], g = [F K, 0] and L = F - g h' the innovations that it makes are h' L ... L e. Gaps, changes of the noise
// and a covariance that has not settled are in the gains.
struct Shifts {
    double *A;       // [n] information: the sum of the squares of these innovations, whitened
    double *B;       // [n, columns] their products with the whitened innovations of the record and of each column
    double *impulse; // [n] the information of a single shifted sample
};

// Of models of D to MOST states: the sums; those and what a shift adds; those and their derivatives by up to `width`
// parameters. likelihood_filter.cpp is compiled for each D and MOST that likelihood.cpp names.
template <int D, int MOST> void filtered(bool diagonal, const Input &in, const Sums &out);
template <int D, int MOST> void shifted(const Input &in, const Sums &out, const Shifts &shifts);
template <int D, int MOST> void differentiated(bool diagonal, const Input &in, const Sums &out, const Slopes &slopes);

} // namespace likelihood

#endif
