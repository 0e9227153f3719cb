/* The functions of math.h whose last digits differ between machines, with the same bits on all of them. Made by fpirhc. */

#ifndef @NAME@_MATH_H
#define @NAME@_MATH_H

#include <math.h>

#define @NAME@_IS_float 1
#define @NAME@_JOINED(type) @NAME@_IS_##type
#define @NAME@_IS(type) @NAME@_JOINED(type)

double @name@_exp(double x);
double @name@_log(double x);
double @name@_pow(double x, double y);
double @name@_sin(double x);
double @name@_cos(double x);
double @name@_tanh(double x);
double @name@_atanh(double x);

#if defined(casadi_real) && @NAME@_IS(casadi_real)
/* In float they are the target's own, without a detour over doubles. */
#define exp expf
#define log logf
#define pow powf
#define sin sinf
#define cos cosf
#define tan tanf
#define tanh tanhf
#define atanh atanhf
#define asin asinf
#define acos acosf
#define atan atanf
#define atan2 atan2f
#define sinh sinhf
#define cosh coshf
#define asinh asinhf
#define acosh acoshf
#define sqrt sqrtf
#define fabs fabsf
#define fmin fminf
#define fmax fmaxf
#define fmod fmodf
#define floor floorf
#define ceil ceilf
#define rint rintf
#define lrint lrintf
#define hypot hypotf
#else
#define exp @name@_exp
#define log @name@_log
#define pow @name@_pow
#define sin @name@_sin
#define cos @name@_cos
#define tanh @name@_tanh
#define atanh @name@_atanh
#endif

#endif
