/* The words of one loop in each work item of an OpenCL device; lanes.c has those of numbers side by side. */
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#pragma OPENCL FP_CONTRACT OFF
#define LANES 1
#define GLOBAL __global
#define FINITE (DBL_MAX / 134217728)
#define TINY (DBL_MIN * 67108864)
#define OF_TYPE(of_double, of_float) (of_double)
#define PORTABLE
#define INLINE static inline
#define NOT_UNROLLED
#define TABLE __constant
typedef double V, Number, casadi_real;
typedef long casadi_int;
typedef int M, Truth;
#define YES 1
#define NO 0
#define NOT(m) (!(m))
#define ANY(m) (m)
#define EVERY(m) (m)
#define EITHER(m, a, b) ((m) ? (a) : (b))
#define ALL(a) (a)
static double truth(int m) { return m ? 1.0 : 0.0; }
static double fetched(__global const double* from) { return *from; }
static void stored(__global double* to, double a) { *to = a; }

INLINE Truth all_finite(const casadi_real* v, int n) {
  int i;
  Truth ok = YES;
  for (i = 0; i < n; ++i) ok &= fabs(v[i]) <= FINITE; /* false for NaN */
  return ok;
}
