/* The closed loop over LANES plants side by side. Defined before: LANES, the sizes MEMORY, TRACE, READS, ERRORS and the place
   FIRST_ERROR of the errors in the trace; the instructions of a cycle and the ranges that end a run are written in. */
#include <math.h>
#include <string.h>

typedef double V __attribute__((vector_size(8 * LANES)));
typedef long long M __attribute__((vector_size(8 * LANES)));
#define INLINE static inline __attribute__((always_inline, unused))

INLINE V all(double a) { return (V){} + a; }
INLINE V truth(M m) { return (V)(m & (M)all(1.0)); }
INLINE V where(M m, V a) { return (V)(m & (M)a); }
INLINE V either(M m, V a, V b) { return (V)((m & (M)a) | (~m & (M)b)); }
INLINE V least(V a, V b) { return either((a < b) | (b != b), a, b); } /* fmin and fmax: the other one of NaN */
INLINE V most(V a, V b) { return either((a > b) | (b != b), a, b); }
INLINE V size(V a) { return (V)((M)a & ((M){} + 0x7fffffffffffffffLL)); }

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
#define WIDE(name) V OF_WIDTH(v_##name)(V); INLINE V v_##name(V a) { return OF_WIDTH(v_##name)(a); }
#define WIDE_TWO(name) V OF_WIDTH(vv_##name)(V, V); INLINE V v_##name(V a, V b) { return OF_WIDTH(vv_##name)(a, b); }
#else
#define WIDE EACH
#define WIDE_TWO EACH_TWO
#endif
WIDE(exp) WIDE(log) WIDE(sin) WIDE(cos) WIDE(tan) WIDE(asin) WIDE(acos) WIDE(atan) WIDE(sinh) WIDE(cosh) WIDE(tanh)
WIDE(asinh) WIDE(acosh) WIDE(atanh) WIDE(log1p) WIDE(expm1) WIDE_TWO(pow) WIDE_TWO(atan2) WIDE_TWO(hypot)
EACH(sqrt) EACH(floor) EACH(ceil) EACH_TWO(copysign) EACH_TWO(fmod)

static void step(const V* memory, const double* reads, V* next, V* trace) {
  (void)reads;
/* STEP */
}

/* Which lanes have numbers that end a run. */
static M ended(const V* memory, const V* trace) {
  M bad = (M){};
  int i;
  for (i = 0; i < MEMORY; ++i) bad |= ~(size(memory[i]) < 1e100);
  for (i = 0; i < TRACE; ++i) bad |= ~(size(trace[i]) < 1e100);
/* RANGES */
  return bad;
}

static void run_group(long cycles, long first, const double* start, const double* reads, double* squares, double* largest, double* left) {
  V a[MEMORY], b[MEMORY], trace[TRACE], sums[ERRORS], sizes[ERRORS], *memory = a, *next = b, *other;
  M bad = (M){};
  V again;
  long k;
  int i;
  memcpy(a, start, sizeof a);
  memset(sums, 0, sizeof sums);
  memset(sizes, 0, sizeof sizes);
  for (k = 0; k < cycles; ++k) {
    step(memory, reads + k * READS, next, trace);
    bad |= ended(next, trace);
    for (i = 0; k >= first && i < ERRORS; ++i) {
      V e = trace[FIRST_ERROR + i];
      sums[i] += e * e;
      sizes[i] = most(sizes[i], size(e));
    }
    other = memory, memory = next, next = other;
  }
  again = truth(bad);
  memcpy(squares, sums, sizeof sums);
  memcpy(largest, sizes, sizeof sizes);
  memcpy(left, &again, sizeof again);
}

void run_lanes(long groups, long cycles, long first, const double* start, const double* reads, double* squares, double* largest, double* left) {
  long g;
  for (g = 0; g < groups; ++g)
    run_group(cycles, first, start + g * MEMORY * LANES, reads, squares + g * ERRORS * LANES, largest + g * ERRORS * LANES, left + g * LANES);
}
