/* @title@ as a mock-up unit of FMI 2.0. Made by fpirhc; see modelDescription.xml.

   A command follows from the inputs of its own cycle: it is computed when it is read after an input was set, and a step puts the memory
   of that cycle in force. Until an input is set after a step, the command of that step stays. */

#include "@name@.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"

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
@checked@
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

/* One cycle from its beginning to the next; 0 where the step is not one period long, or begins elsewhere. */
static int take_step(cycle_state* s, double point, double length) {
  double due = (double)now(s), rounding = 1e-6 * @NAME@_PERIOD + 1e-12 * fabs(due);
  if (!(fabs(length - @NAME@_PERIOD) <= rounding && fabs(point - due) <= rounding)) return 0;
  evaluate(s);
  s->before = s->c.memory;
  ++s->cycle;
  return 1;
}

#define WRONG_NAME "no variable of this kind has this value reference, or it cannot be written"
#define WRONG_VALUE "the number is not finite, outside its bounds, or beyond the other end of its interval; the old one stays"
#define WRONG_STEP "a communication step must be one period of the controller, the stepSize of modelDescription.xml, and begin where the last one ended"

typedef struct {
  cycle_state s;
  const fmi2CallbackFunctions* functions;
} unit;

static fmi2Status failed(unit* u, fmi2Status status, const char* message) {
  if (u->functions && u->functions->logger)
    u->functions->logger(u->functions->componentEnvironment, "@name@", status, "logStatus", message);
  return status;
}

static fmi2Status said(unit* u, int outcome) {
  if (outcome == DONE) return fmi2OK;
  return outcome == REFUSED ? failed(u, fmi2Discard, WRONG_VALUE) : failed(u, fmi2Error, WRONG_NAME);
}

const char* fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char* fmi2GetVersion(void) { return "2.0"; }

fmi2Component fmi2Instantiate(fmi2String instance, fmi2Type type, fmi2String token, fmi2String resources,
                              const fmi2CallbackFunctions* functions, fmi2Boolean visible, fmi2Boolean logging) {
  unit* u;
  (void)instance, (void)resources, (void)visible, (void)logging;
  if (type != fmi2CoSimulation || !token || strcmp(token, TOKEN)) return 0;
  u = calloc(1, sizeof *u);
  if (!u) return 0;
  u->functions = functions;
  begin(&u->s);
  return u;
}

void fmi2FreeInstance(fmi2Component instance) { free(instance); }

fmi2Status fmi2SetDebugLogging(fmi2Component instance, fmi2Boolean on, size_t number, const fmi2String categories[]) {
  (void)instance, (void)on, (void)number, (void)categories;
  return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component instance, fmi2Boolean tolerances, fmi2Real tolerance, fmi2Real start, fmi2Boolean stops,
                               fmi2Real stop) {
  (void)tolerances, (void)tolerance, (void)stops, (void)stop;
  start_at(&((unit*)instance)->s, start);
  return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component instance) { return (void)instance, fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component instance) { return (void)instance, fmi2OK; }
fmi2Status fmi2Terminate(fmi2Component instance) { return (void)instance, fmi2OK; }
fmi2Status fmi2Reset(fmi2Component instance) { return begin(&((unit*)instance)->s), fmi2OK; }

fmi2Status fmi2GetReal(fmi2Component instance, const fmi2ValueReference r[], size_t number, fmi2Real values[]) {
  unit* u = instance;
  size_t k;
  int outcome = DONE;
  for (k = 0; k < number && outcome == DONE; ++k) outcome = get_number(&u->s, r[k], &values[k]);
  return said(u, outcome);
}

fmi2Status fmi2SetReal(fmi2Component instance, const fmi2ValueReference r[], size_t number, const fmi2Real values[]) {
  unit* u = instance;
  size_t k;
  int outcome = DONE;
  for (k = 0; k < number && outcome == DONE; ++k) outcome = set_number(&u->s, r[k], values[k]);
  return said(u, outcome);
}

fmi2Status fmi2GetInteger(fmi2Component instance, const fmi2ValueReference r[], size_t number, fmi2Integer values[]) {
  unit* u = instance;
  size_t k;
  int outcome = DONE;
  for (k = 0; k < number && outcome == DONE; ++k) outcome = get_status(&u->s, r[k], &values[k]);
  return said(u, outcome);
}

fmi2Status fmi2DoStep(fmi2Component instance, fmi2Real point, fmi2Real length, fmi2Boolean no_return) {
  unit* u = instance;
  (void)no_return;
  return take_step(&u->s, point, length) ? fmi2OK : failed(u, fmi2Error, WRONG_STEP);
}

/* A state is not written as bytes. */
fmi2Status fmi2SerializeFMUstate(fmi2Component instance, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
  (void)instance, (void)state, (void)bytes, (void)size;
  return fmi2Error;
}
