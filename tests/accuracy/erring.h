/* Put in front of lib/ by -include: the functions of <math.h> that it calls, made to err. */
#ifndef ERRING_H
#define ERRING_H

#include <math.h>

float erring_float(float value, float x, int which);
double erring_double(double value, double x, int which);

#define expf(x) erring_float((expf)(x), x, 0)
#define expm1f(x) erring_float((expm1f)(x), x, 1)
#define logf(x) erring_float((logf)(x), x, 2)
#define log1pf(x) erring_float((log1pf)(x), x, 3)
#define sqrtf(x) erring_float((sqrtf)(x), x, 4)
#define exp(x) erring_double((exp)(x), x, 0)
#define expm1(x) erring_double((expm1)(x), x, 1)
#define log(x) erring_double((log)(x), x, 2)
#define log1p(x) erring_double((log1p)(x), x, 3)
#define sqrt(x) erring_double((sqrt)(x), x, 4)

#endif
