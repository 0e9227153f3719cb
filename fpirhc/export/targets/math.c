/* exp, log, pow, sin, cos, tanh, atanh from + - * / and whole numbers alone: the same bits on every machine with IEEE doubles, as long
   as no fused multiply-add is made. Made by fpirhc; errors are below 1.5 units in the last place, for sin and cos up to 1e12. */

#undef casadi_real /* doubles here, whatever the controller computes in */
#include "@name@_math.h"

#include <string.h>

#undef exp
#undef log
#undef pow
#undef sin
#undef cos
#undef tanh
#undef atanh

/* ln 2 and pi / 2 in parts; products of a first part with whole numbers below 2^20 are exact. */
static const double LN2 = 6.93147180369123816490e-01, LN2_REST = 1.90821492927058770002e-10;
static const double TURN[4] = {1.57079632673412561417e+00, 6.07710050630396597660e-11, 2.02226624871116645580e-21, 8.47842766036889956997e-32};

/* A number as the sum of two. */
typedef struct {
  double high, low;
} pair;

static unsigned long long bits_of(double x) {
  unsigned long long bits;
  memcpy(&bits, &x, sizeof bits);
  return bits;
}

static double of_bits(unsigned long long bits) {
  double x;
  memcpy(&x, &bits, sizeof x);
  return x;
}

/* The nearest whole number, for |x| < 2^51. */
static double whole(double x) { return (x + 6755399441055744.0) - 6755399441055744.0; }

static double power_of_2(int k) { return of_bits((unsigned long long)(1023 + k) << 52); }

/* x 2^k with one rounding. */
static double scaled(double x, int k) {
  if (k > 1023) return x * power_of_2(1023) * (k - 1023 > 1023 ? power_of_2(1023) : power_of_2(k - 1023));
  return k < -1022 ? x * power_of_2(k + 1022 < -1022 ? -1022 : k + 1022) * power_of_2(-1022) : x * power_of_2(k);
}

static pair sum(double a, double b) {
  pair p;
  double bb;
  p.high = a + b, bb = p.high - a;
  p.low = (a - (p.high - bb)) + (b - bb);
  return p;
}

static pair product(double a, double b) {
  pair p;
  double t = 134217729.0 * a, ah = t - (t - a), al = a - ah, bh, bl;
  t = 134217729.0 * b, bh = t - (t - b), bl = b - bh;
  p.high = a * b;
  p.low = ((ah * bh - p.high) + ah * bl + al * bh) + al * bl;
  return p;
}

static pair times(pair a, pair b) {
  pair p = product(a.high, b.high);
  p.low += a.high * b.low + a.low * b.high;
  return sum(p.high, p.low);
}

/* exp(x + low) 2^-n = 1 + r + r c / (2 - c) after r = x + low - n ln 2; c = r + 2 - r coth(r / 2) = r - r^2/6 + r^4/360 - ..., interpolated
   at Chebyshev's nodes. */
static double mantissa_of_exp(double x, double low, int* k) {
  double n = whole(x * 1.4426950408889634), high = x - n * LN2, rest = n * LN2_REST - low, r = high - rest, z = r * r, c;
  c = 4.1437682605934066e-08 * z - 1.6534060075471242e-06, c = c * z + 6.613756471649627e-05, c = c * z - 2.7777777777564456e-03;
  c = r - z * (c * z + 1.6666666666666660e-01), *k = (int)n;
  return 1 + (high + (r * c / (2 - c) - rest));
}

/* The same of 708 and more, and of what is not a number. */
static double far_exponential(double x, double low) {
  int k;
  if (x != x) return x;
  if (x > 709.79) return HUGE_VAL;
  if (x < -745.2) return 0;
  x = mantissa_of_exp(x, low, &k);
  return scaled(x, k);
}

static double exponential(double x, double low) {
  int k;
  if (!(fabs(x) < 708)) return far_exponential(x, low);
  x = mantissa_of_exp(x, low, &k);
  return x * power_of_2(k);
}

/* Written out: the rest that is 0 needs no instructions. */
double @name@_exp(double x) {
  int k;
  if (!(fabs(x) < 708)) return far_exponential(x, 0);
  x = mantissa_of_exp(x, 0, &k);
  return x * power_of_2(k);
}

/* x = m 2^k with m between sqrt(1/2) and sqrt(2), to six digits, of the bits of a number that has all of its digits. */
static double parted(unsigned long long bits, int* k) {
  *k = (int)((bits + 0x3ff0000000000000u - 0x3fe6a09e00000000u) >> 52) - 1023;
  return of_bits(bits - ((unsigned long long)*k << 52));
}

/* The same of every number above zero. */
static double mantissa(double x, int* k) {
  double m;
  if (x >= 2.2250738585072014e-308) return parted(bits_of(x), k);
  m = parted(bits_of(x * 18014398509481984.0), k), *k -= 54;
  return m;
}

/* log of what has no mantissa: not a number, negative, zero, infinite; 0 where x is none of these. */
static int has_no_log(double x, double* value) {
  if (x > 0 && x - x == 0) return 0;
  *value = x > 0 || x != x ? x : x == 0 ? -HUGE_VAL : (x - x) / (x - x);
  return 1;
}

/* log(1 + f) = 2 atanh(s), s = f / (2 + f) = f - f^2/2 + s (f^2/2 + R); R is interpolated at Chebyshev's nodes. */
double @name@_log(double x) {
  int k;
  unsigned long long bits = bits_of(x);
  double f, s, z, half, series = 0.14425745969553938;
  if (bits - 0x0010000000000000u < 0x7fe0000000000000u) f = parted(bits, &k) - 1;
  else if (has_no_log(x, &f)) return f;
  else f = mantissa(x, &k) - 1;
  s = f / (2 + f), z = s * s, half = 0.5 * f * f;
  series = series * z + 0.15347854217867402, series = series * z + 0.18182383516054826, series = series * z + 0.22222218306451125;
  series = series * z + 0.2857142858132756, series = series * z + 0.3999999999999595, series = series * z + 0.6666666666666666;
  return k * LN2 - ((half - (s * (half + series * z) + k * LN2_REST)) - f);
}

/* log as a sum of two: s, s^2 and the cube's share in twice the digits. */
static pair logarithm(double x) {
  static const pair third = {0.66666666666666663, 3.7007434154171886e-17};
  int k, j;
  double f = mantissa(x, &k) - 1, series = 2.0 / 27;
  pair g = sum(2, f), s, z, cube, p, q, total;
  s.high = f / g.high, p = product(s.high, g.high);
  s.low = (((f - p.high) - p.low) - s.high * g.low) / g.high;
  z = times(s, s), cube = times(times(z, s), third);
  for (j = 25; j >= 5; j -= 2) series = series * z.high + 2.0 / j;
  total = sum(2 * s.high, cube.high);
  total.low += 2 * s.low + cube.low + series * z.high * z.high * s.high;
  p = sum(k * LN2, total.high), q = sum(p.low + k * LN2_REST, total.low);
  total = sum(p.high, q.high);
  total.low += q.low;
  return total;
}

double @name@_pow(double x, double y) {
  double size = fabs(x), sign = 1;
  int odd = fabs(fmod(y, 2)) == 1;
  pair l, p;
  if (y == 0 || x == 1) return 1;
  if (x != x || y != y) return x + y;
  if (x < 0 || (x == 0 && odd && bits_of(x) >> 63)) {
    if (floor(y) < y && x - x == 0 && x != 0) return (x - x) / (x - x);
    sign = odd ? -1 : 1;
  }
  if (size == 1) return sign;
  if (size == 0 || size - size != 0) return sign * ((size == 0) == (y > 0) ? 0 : HUGE_VAL);
  if (y - y != 0) return (size > 1) == (y > 0) ? HUGE_VAL : 0;
  l = logarithm(size);
  if (fabs(y) > 1e300 || fabs(y * l.high) > 800) return sign * (y * (l.high > 0 ? 1 : -1) > 0 ? HUGE_VAL : 0);
  if (fabs(y) < 1e-290) return sign;
  p = product(y, l.high);
  return sign * exponential(p.high, p.low + y * l.low);
}

static const double LARGE = 1048576.0; /* 2^20: whole turns */

/* x less whole turns, where it is large, as a sum of two. */
static pair unturned(double x) {
  double n;
  pair r, p;
  int k;
  if (fabs(x) > 1e12) x = fmod(x, LARGE * LARGE);
  r.high = x, r.low = 0;
  if (fabs(x) <= LARGE) return r;
  n = whole(x * (0.63661977236758138 / LARGE)) * LARGE;
  for (k = 0; k < 4; ++k) p = sum(r.high, -(n * TURN[k])), r.low += p.low, r.high = p.high;
  return sum(r.high, r.low);
}

/* r less the nearest multiple of pi / 2, and the quarter turn that it is in. */
static pair reduced(pair r, int* quarter) {
  double n = whole(r.high * 0.63661977236758138);
  pair p;
  int k;
  *quarter = (int)n & 3; /* below 2^20 */
  if (n == 0) return r;
  r.high -= n * TURN[0]; /* without rounding */
  p = sum(r.high, -(n * TURN[1])), r.low += p.low, r.high = p.high;
  if (fabs(n * TURN[2]) >= 1e-19 * fabs(r.high)) /* else the rest does not count */
    for (k = 2; k < 4; ++k) p = sum(r.high, -(n * TURN[k])), r.low += p.low, r.high = p.high;
  return sum(r.high, r.low);
}

/* sin(x + turn pi / 2); (sin r - r) / r^3 and (cos r - 1 + r^2/2) / r^4 are interpolated at Chebyshev's nodes. */
static double wave(double x, int turn) {
  double z, q, value;
  pair r;
  int quarter;
  r.high = x, r.low = 0;
  if (!(fabs(x) <= LARGE)) {
    if (!(x - x == 0)) return x - x;
    r = unturned(x);
  }
  r = reduced(r, &quarter), quarter += turn, z = r.high * r.high;
  if (quarter & 1) {
    q = -1.1382614868556325e-11, q = q * z + 2.0876146024689747e-09, q = q * z - 2.7557317270560326e-07;
    q = q * z + 2.4801587298763433e-05, q = q * z - 1.3888888888887395e-03, q = q * z + 4.1666666666666664e-02;
    value = 1 - 0.5 * z;
    value += ((1 - value) - 0.5 * z) + (z * z * q - r.high * r.low);
  } else {
    q = 1.591810123027412e-10, q = q * z - 2.5051131455427946e-08, q = q * z + 2.755731610068303e-06;
    q = q * z - 1.9841269836754970e-04, q = q * z + 8.333333333330946e-03, q = q * z - 1.6666666666666666e-01;
    value = r.high + (r.low * (1 - 0.5 * z) + r.high * z * q);
  }
  return quarter & 2 ? -value : value;
}

double @name@_sin(double x) { return x == 0 ? x : wave(x, 0); }
double @name@_cos(double x) { return wave(x, 1); }

/* x - x z / (d + z), d = 3 + z / (5 + z / (7 + ...)), z = x^2 (Lambert); and 1 - 2 / (exp(2 x) + 1). */
double @name@_tanh(double x) {
  double size = fabs(x), z = x * x, d = 21, value;
  int k;
  if (x == 0) return x;
  if (size < 0.625) {
    for (k = 19; k >= 3; k -= 2) d = k + z / d;
    return x - x * (z / (d + z));
  }
  value = size > 22 ? 1 : x != x ? x : 1 - 2 / (exponential(2 * size, 0) + 1);
  return x < 0 ? -value : value;
}

/* x + x z / (d - z), d = 3 - 4 z / (5 - 9 z / (7 - ...)) (Gauss); and log((1 + x) / (1 - x)) / 2. */
double @name@_atanh(double x) {
  double z = x * x, d = 49;
  int k;
  if (fabs(x) >= 0.5 || x != x) return x < 0 ? -@name@_atanh(-x) : 0.5 * @name@_log((1 + x) / (1 - x));
  for (k = 24; k >= 2; --k) d = 2 * k - 1 - k * k * z / d;
  return x + x * (z / (d - z));
}
