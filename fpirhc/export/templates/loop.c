/* A closed loop that runs @cycles@ cycles: keeps some signals of every @every@th cycle, and the sum of squares of errors from a cycle on.
   Made by fpirhc. */

@declaration@

#define EXPORT(name) __attribute__((export_name(name)))

enum { MEMORY = @memory@, TRACE = @trace@, CYCLES = @cycles@, EVERY = @every@, SHOWN = @shown@, ERRORS = @errors@, FIRST = @first@ };

static double memory[2][MEMORY], trace[TRACE], kept[(CYCLES / EVERY + 1) * SHOWN], squares[ERRORS];
static const int PLACES[SHOWN] = {@places@}, ERROR_PLACES[ERRORS] = {@error_places@};
static const int BOUNDED[] = {@bounded@}; /* what ends a run where it is outside: states with a physical range, and errors */
static const double LOWER[] = {@lower@}, UPPER[] = {@upper@};
static const double* arg[@arg@];
static double* res[@res@];
static long long whole_numbers[@iw@];
static double work[@w@];
@tables@

EXPORT("memory_at") void* memory_at(void) { return memory[0]; }
EXPORT("kept_at") void* kept_at(void) { return kept; }
EXPORT("squares_at") void* squares_at(void) { return squares; }

/* Returns the number of cycles before a signal that is shown was no number or left its range, or a solver failed. */
EXPORT("run") int run(void) {
  int k, j, rows = 0;
  for (j = 0; j < ERRORS; ++j) squares[j] = 0;
  for (k = 0; k < CYCLES; ++k) {
    arg[0] = memory[k & 1], res[0] = memory[1 - (k & 1)], res[1] = trace;
@arguments@
    if (lab_raw(arg, res, whole_numbers, work, 0)) return k;
    for (j = 0; j < SHOWN; ++j)
      if (!(trace[PLACES[j]] - trace[PLACES[j]] == 0)) return k;
    for (j = 0; j < (int)(sizeof BOUNDED / sizeof *BOUNDED); ++j)
      if (trace[BOUNDED[j]] < LOWER[j] || trace[BOUNDED[j]] > UPPER[j]) return k;
    if (k % EVERY == 0) {
      for (j = 0; j < SHOWN; ++j) kept[rows * SHOWN + j] = trace[PLACES[j]];
      ++rows;
    }
    if (k >= FIRST)
      for (j = 0; j < ERRORS; ++j) squares[j] += trace[ERROR_PLACES[j]] * trace[ERROR_PLACES[j]];
  }
  return CYCLES;
}
