/* The functions of math.h whose last digits differ between machines, with the same bits on all of them. Made by fpirhc. */

#ifndef @NAME@_MATH_H
#define @NAME@_MATH_H

#include <math.h>

double @name@_exp(double x);
double @name@_log(double x);
double @name@_pow(double x, double y);
double @name@_sin(double x);
double @name@_cos(double x);
double @name@_tanh(double x);
double @name@_atanh(double x);

#define exp @name@_exp
#define log @name@_log
#define pow @name@_pow
#define sin @name@_sin
#define cos @name@_cos
#define tanh @name@_tanh
#define atanh @name@_atanh

#endif
