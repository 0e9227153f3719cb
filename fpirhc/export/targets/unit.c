/* @title@ as a mock-up unit: what FMI 2 and FMI 3 have in common. Made by fpirhc; see modelDescription.xml.

   A command follows from the inputs of its own cycle: it is computed when it is read after an input was set, and a step puts the memory
   of that cycle in force. Until an input is set after a step, the command of that step stays. */

#include "@name@.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

@references@

typedef struct {
  @name@_controller c;
  @name@_memory before; /* the memory at the beginning of the cycle */
  @name@_inputs in;
  @name@_command out;
  casadi_real start; /* time of the first cycle */
  long cycle;
  int fresh, status;
} cycle_state;

enum { DONE, UNKNOWN, REFUSED };

static void begin(cycle_state* s) {
  memset(s, 0, sizeof *s);
  @name@_init(&s->c);
  s->before = s->c.memory;
}

/* The time is counted in cycles, so that it is that of a run to the last bit. */
static casadi_real now(const cycle_state* s) { return s->start + (casadi_real)s->cycle * @NAME@_PERIOD; }

/* What was computed for another time is computed again. */
static void start_at(cycle_state* s, double time) {
  s->start = (casadi_real)time;
  s->fresh = 0;
}

static void evaluate(cycle_state* s) {
  if (s->fresh) return;
  s->c.memory = s->before;
  s->in.time = now(s);
  s->status = (int)@name@_step(&s->c, &s->in, &s->out);
  s->fresh = 1;
}

/* Where a number is that a master may write; 0 where there is none. */
static casadi_real* written(cycle_state* s, unsigned r) {
@written@
  (void)s, (void)r;
  return 0;
}

/* Where a number is that a master may read; 0 where there is none. */
static casadi_real* place(cycle_state* s, unsigned r) {
  if (r >= COMMANDS && r < COMMANDS + @NAME@_COMMANDS) return (casadi_real*)&s->out + (r - COMMANDS);
  if (r >= TRACE && r < TRACE + @NAME@_TRACE) return (casadi_real*)&s->c.trace + (r - TRACE);
@settings_read@
  return written(s, r);
}

static int get_number(cycle_state* s, unsigned r, double* value) {
  const casadi_real* at;
  if (r == TIME) return *value = (double)now(s), DONE;
  if (!(at = place(s, r))) return UNKNOWN;
  evaluate(s);
  return *value = (double)*at, DONE;
}

static int set_number(cycle_state* s, unsigned r, double value) {
  casadi_real* at = written(s, r);
@settings_written@
  if (!at) return UNKNOWN;
  *at = (casadi_real)value;
  s->fresh = 0;
  return DONE;
}

static int get_status(cycle_state* s, unsigned r, int* value) {
  if (r != STATUS) return UNKNOWN;
  evaluate(s);
  return *value = s->status, DONE;
}

/* One cycle from its beginning to the next; 0 where the step is not one period long. */
static int take_step(cycle_state* s, double length) {
  if (!(fabs(length - @NAME@_PERIOD) <= 1e-6 * @NAME@_PERIOD)) return 0;
  evaluate(s);
  s->before = s->c.memory;
  ++s->cycle;
  return 1;
}

#define WRONG_NAME "no variable of this kind has this value reference, or it cannot be written"
#define WRONG_VALUE "the number is not finite, outside its bounds, or beyond the other end of its interval; the old one stays"
#define WRONG_STEP "a communication step must be one period of the controller: the fixedInternalStepSize of modelDescription.xml"
