/* The closed loop over LANES plants side by side, or in each work item of a device. Defined before: STEP, one cycle, with its ROOM, the sizes MEMORY, TRACE, READS, ERRORS
   and STATUSES, the places FIRST_ERROR and STATUS in the trace, TABLES, the addresses of what a cycle reads, and the ranges that end a run. */

/* Which lanes have numbers that end a run. */
static M ended(const V* memory, const V* trace) {
  M bad = NO;
  int i;
  for (i = 0; i < MEMORY; ++i) bad |= NOT(fabs(memory[i]) < 1e100);
  for (i = 0; i < TRACE; ++i) bad |= NOT(fabs(trace[i]) < 1e100);
/* RANGES */
  return bad;
}

#define FIGURES (2 * ERRORS + STATUSES + 1)

/* Results of a lane: sums of squares and largest sizes of the errors, cycles with each status, whether it ended. */
static void run_group(long cycles, long first, GLOBAL const double* start, GLOBAL const double* reads, GLOBAL double* results, V* w) {
  V a[MEMORY], b[MEMORY], trace[TRACE], now[READS + 1], found[FIGURES], *memory = a, *next = b, *other;
  V *sums = found, *sizes = found + ERRORS, *counts = found + 2 * ERRORS;
  M bad = NO;
  long k;
  int i;
  for (i = 0; i < MEMORY; ++i) a[i] = fetched(start + i * LANES);
  for (i = 0; i < FIGURES; ++i) found[i] = ALL(0.0);
  for (k = 0; k < cycles; ++k) {
    const V* arg[] = {memory, TABLES};
    V* res[] = {next, trace};
    for (i = 0; i < READS; ++i) now[i] = ALL(reads[k * READS + i]);
    if (STEP(arg, res, 0, w, 0)) bad = YES;
    bad |= ended(next, trace);
    for (i = 0; k >= first && i < ERRORS; ++i) {
      V e = trace[FIRST_ERROR + i];
      sums[i] += e * e;
      sizes[i] = fmax(sizes[i], fabs(e));
    }
    if (ANY(trace[STATUS] != 0))
      for (i = 1; i < STATUSES; ++i) counts[i] += truth(trace[STATUS] == i);
    other = memory, memory = next, next = other;
  }
  found[FIGURES - 1] = truth(bad);
  for (i = 0; i < FIGURES; ++i) stored(results + i * LANES, found[i]);
}

#ifdef __OPENCL_VERSION__
__kernel void run_lanes(long cycles, long first, __global const double* start, __global const double* reads, __global double* results) {
  size_t g = get_global_id(0);
  V w[ROOM + 1];
  run_group(cycles, first, start + g * MEMORY, reads, results + g * FIGURES, w);
}
#else
#include <stdint.h>
#include <stdlib.h>

/* Returns whether there was room. */
int run_lanes(long groups, long cycles, long first, const double* start, const double* reads, double* results) {
  char* room = malloc((ROOM + 1) * sizeof(V));
  V* w = (V*)(room + sizeof(V) - (uintptr_t)room % sizeof(V));
  long g;
  for (g = 0; room && g < groups; ++g)
    run_group(cycles, first, start + g * MEMORY * LANES, reads, results + g * FIGURES * LANES, w);
  free(room);
  return room != 0;
}
#endif
