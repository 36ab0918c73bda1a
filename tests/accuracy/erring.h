/* Put in front of lib/ by -include: the functions of <math.h> that it calls, made to err. */
#ifndef ERRING_H
#define ERRING_H

#include <math.h>

float erring_float(float value, int which);
double erring_double(double value, int which);

#define expf(x) erring_float((expf)(x), 0)
#define expm1f(x) erring_float((expm1f)(x), 1)
#define logf(x) erring_float((logf)(x), 2)
#define log1pf(x) erring_float((log1pf)(x), 3)
#define sqrtf(x) erring_float((sqrtf)(x), 4)
#define exp(x) erring_double((exp)(x), 0)
#define expm1(x) erring_double((expm1)(x), 1)
#define log(x) erring_double((log)(x), 2)
#define log1p(x) erring_double((log1p)(x), 3)
#define sqrt(x) erring_double((sqrt)(x), 4)

#endif
