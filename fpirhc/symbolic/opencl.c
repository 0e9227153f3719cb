/* The words of one loop in each work item of an OpenCL device; lanes.c has those of numbers side by side. */
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#pragma OPENCL FP_CONTRACT OFF
#define LANES 1
#define GLOBAL __global
typedef double V, casadi_real;
typedef long casadi_int;
typedef int M;
#define YES 1
#define NO 0
#define NOT(m) (!(m))
#define ANY(m) (m)
#define ALL(a) (a)
static double truth(int m) { return m ? 1.0 : 0.0; }
static double fetched(__global const double* from) { return *from; }
static void stored(__global double* to, double a) { *to = a; }
