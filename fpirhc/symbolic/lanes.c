/* The words of numbers side by side: LANES of them, each of its own loop, are one value. `driver.WORDS` are those of one number. */
#include <float.h>
#include <math.h>
#include <string.h>
#define FINITE (DBL_MAX / 134217728)
#define TINY (DBL_MIN * 67108864)
#define OF_TYPE(of_double, of_float) (of_double)
#define PORTABLE /* the flags say how wide registers are */
#define INLINE static inline __attribute__((always_inline, unused))
#define NOT_UNROLLED

typedef double V __attribute__((vector_size(8 * LANES)));
typedef long long M __attribute__((vector_size(8 * LANES)));
typedef M Truth;
typedef double Number;
#define TABLE static const
#define casadi_real V
#define casadi_int long long
#define YES (~(M){})
#define NO ((M){})
#define NOT(m) (~(m))
#define ALL(a) ((V){} + (a))
#define EITHER(m, a, b) either(m, a, b)
#if LANES == 8
#define ROW(a) {a, a, a, a, a, a, a, a}
#elif LANES == 4
#define ROW(a) {a, a, a, a}
#else
#define ROW(a) {a, a}
#endif

INLINE int ANY(M m) {
  long long some = 0;
  int l;
  for (l = 0; l < LANES; ++l) some |= m[l];
  return some != 0;
}
INLINE int EVERY(M m) { return !ANY(~m); }
#define GLOBAL
INLINE V fetched(const double* from) { V a; memcpy(&a, from, sizeof a); return a; }
INLINE void stored(double* to, V a) { memcpy(to, &a, sizeof a); }
INLINE V truth(M m) { return (V)(m & (M)ALL(1.0)); }
INLINE V where(M m, V a) { return (V)(m & (M)a); }
INLINE V either(M m, V a, V b) { return (V)((m & (M)a) | (~m & (M)b)); }
INLINE V v_fmin(V a, V b) { return either((a < b) | (b != b), a, b); } /* fmin and fmax: the other one of NaN */
INLINE V v_fmax(V a, V b) { return either((a > b) | (b != b), a, b); }
INLINE V v_fabs(V a) { return (V)((M)a & ((M){} + 0x7fffffffffffffffLL)); }

#define EACH(name) INLINE V v_##name(V a) { int l; for (l = 0; l < LANES; ++l) a[l] = name(a[l]); return a; }
#define EACH_TWO(name) INLINE V v_##name(V a, V b) { int l; for (l = 0; l < LANES; ++l) a[l] = name(a[l], b[l]); return a; }
#ifdef VECTOR_LIBRARY
#if LANES == 8
#define OF_WIDTH(name) _ZGVeN8##name
#elif LANES == 4
#define OF_WIDTH(name) _ZGVdN4##name
#else
#define OF_WIDTH(name) _ZGVbN2##name
#endif
#define SOME(name) V OF_WIDTH(v_##name)(V); INLINE V v_##name(V a) { return OF_WIDTH(v_##name)(a); }
#define SOME_TWO(name) V OF_WIDTH(vv_##name)(V, V); INLINE V v_##name(V a, V b) { return OF_WIDTH(vv_##name)(a, b); }
#else
#define SOME EACH
#define SOME_TWO EACH_TWO
#endif
SOME(exp) SOME(log) SOME(sin) SOME(cos) SOME(tan) SOME(asin) SOME(acos) SOME(atan) SOME(sinh) SOME(cosh) SOME(tanh)
SOME(asinh) SOME(acosh) SOME(atanh) SOME(log1p) SOME(expm1) SOME(erf) SOME_TWO(pow) SOME_TWO(atan2) SOME_TWO(hypot)
EACH(sqrt) EACH(floor) EACH(ceil) EACH_TWO(copysign) EACH_TWO(fmod)

#define fabs v_fabs
#define fmin v_fmin
#define fmax v_fmax
#define exp v_exp
#define log v_log
#define sqrt v_sqrt
#define sin v_sin
#define cos v_cos
#define tan v_tan
#define asin v_asin
#define acos v_acos
#define atan v_atan
#define sinh v_sinh
#define cosh v_cosh
#define tanh v_tanh
#define asinh v_asinh
#define acosh v_acosh
#define atanh v_atanh
#define log1p v_log1p
#define expm1 v_expm1
#define erf v_erf
#define floor v_floor
#define ceil v_ceil
#define pow v_pow
#define atan2 v_atan2
#define hypot v_hypot
#define copysign v_copysign
#define fmod v_fmod

INLINE Truth all_finite(const casadi_real* v, int n) {
  int i;
  Truth ok = YES;
  for (i = 0; i < n; ++i) ok &= fabs(v[i]) <= FINITE; /* false for NaN */
  return ok;
}
