/* The closed loop over LANES plants side by side, or in each work item of a device. Defined before: STEP, one cycle, and SUM, which sums it up, with
   the ROOM of both, the sizes MEMORY, TRACE, READS, SUMS and KEPT, and TABLES, the addresses of what a cycle reads. */

/* Which lanes have numbers that end a run. */
static M ended(const V* memory, const V* trace) {
  M bad = NO;
  int i;
  for (i = 0; i < MEMORY; ++i) bad |= NOT(fabs(memory[i]) < 1e100);
  for (i = 0; i < TRACE; ++i) bad |= NOT(fabs(trace[i]) < 1e100);
  return bad;
}

/* Results of a lane: its sums, and whether it ended; with KEPT, what is kept of every cycle. `own`: every lane has its own tables. */
static void run_group(long cycles, long first, long own, GLOBAL const double* start, GLOBAL const double* begun,
                      GLOBAL const double* reads, GLOBAL double* results, GLOBAL double* log, V* w) {
  V a[MEMORY], b[MEMORY], trace[TRACE], now[READS + 1], c[SUMS], d[SUMS], kept[KEPT + 1], when[2];
  V *memory = a, *next = b, *sums = c, *summed = d, *other;
  M bad = NO;
  long k;
  int i;
  for (i = 0; i < MEMORY; ++i) a[i] = fetched(start + i * LANES);
  for (i = 0; i < SUMS; ++i) c[i] = fetched(begun + i * LANES);
  for (k = 0; k < cycles; ++k) {
    const V* arg[] = {memory, TABLES};
    V* res[] = {next, trace};
    const V* taken[] = {sums, trace, when};
    V* made[] = {summed, kept};
    for (i = 0; i < READS; ++i) now[i] = own ? fetched(reads + (k * READS + i) * LANES) : ALL(reads[k * READS + i]);
    when[0] = ALL((double)k), when[1] = ALL(k >= first ? 1.0 : 0.0);
    if (STEP(arg, res, 0, w, 0)) bad = YES;
    bad |= ended(next, trace);
    SUM(taken, made, 0, w, 0);
    for (i = 0; i < KEPT; ++i) stored(log + (k * KEPT + i) * LANES, kept[i]);
    other = memory, memory = next, next = other;
    other = sums, sums = summed, summed = other;
  }
  for (i = 0; i < SUMS; ++i) stored(results + i * LANES, sums[i]);
  stored(results + SUMS * LANES, truth(bad));
}

#ifdef __OPENCL_VERSION__
__kernel void run_lanes(long cycles, long first, long own, __global const double* start, __global const double* begun,
                        __global const double* reads, __global double* results, __global double* log) {
  size_t g = get_global_id(0);
  V w[ROOM + 1];
  run_group(cycles, first, own, start + g * MEMORY, begun + g * SUMS, reads + own * g * cycles * READS, results + g * (SUMS + 1),
            log + g * cycles * KEPT, w);
}
#else
#include <stdint.h>
#include <stdlib.h>

/* Returns whether there was room. */
int run_lanes(long groups, long cycles, long first, long own, const double* start, const double* begun, const double* reads,
              double* results, double* log) {
  char* room = malloc((ROOM + 1) * sizeof(V));
  V* w = (V*)(room + sizeof(V) - (uintptr_t)room % sizeof(V));
  long g;
  for (g = 0; room && g < groups; ++g)
    run_group(cycles, first, own, start + g * MEMORY * LANES, begun + g * SUMS * LANES, reads + own * g * cycles * READS * LANES,
              results + g * (SUMS + 1) * LANES, log + g * cycles * KEPT * LANES, w);
  free(room);
  return room != 0;
}
#endif
