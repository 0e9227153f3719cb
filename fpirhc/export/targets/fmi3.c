#include "fmi3Functions.h"

typedef struct {
  cycle_state s;
  fmi3InstanceEnvironment environment;
  fmi3LogMessageCallback log;
} unit;

static fmi3Status failed(unit* u, fmi3Status status, const char* message) {
  if (u->log) u->log(u->environment, status, "logStatus", message);
  return status;
}

static fmi3Status said(unit* u, int outcome) {
  if (outcome == DONE) return fmi3OK;
  return outcome == REFUSED ? failed(u, fmi3Discard, WRONG_VALUE) : failed(u, fmi3Error, WRONG_NAME);
}

const char* fmi3GetVersion(void) { return "3.0"; }

fmi3Instance fmi3InstantiateCoSimulation(fmi3String instance, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
                                         const fmi3ValueReference required[], size_t number, fmi3InstanceEnvironment environment,
                                         fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
  unit* u;
  (void)instance, (void)resources, (void)visible, (void)logging, (void)events, (void)early, (void)required, (void)number, (void)update;
  if (!token || strcmp(token, TOKEN)) {
    if (log) log(environment, fmi3Error, "logStatus", "the instantiation token is that of another unit");
    return 0;
  }
  u = calloc(1, sizeof *u);
  if (!u) return 0;
  u->environment = environment, u->log = log;
  begin(&u->s);
  return u;
}

void fmi3FreeInstance(fmi3Instance instance) { free(instance); }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t number, const fmi3String categories[]) {
  (void)instance, (void)on, (void)number, (void)categories;
  return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean tolerances, fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean stops, fmi3Float64 stop) {
  (void)tolerances, (void)tolerance, (void)stops, (void)stop;
  start_at(&((unit*)instance)->s, start);
  return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) { return (void)instance, fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance instance) { return (void)instance, fmi3OK; }
fmi3Status fmi3Reset(fmi3Instance instance) { return begin(&((unit*)instance)->s), fmi3OK; }

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference r[], size_t number, fmi3Float64 values[], size_t size) {
  unit* u = instance;
  size_t k;
  int outcome = number == size ? DONE : UNKNOWN;
  for (k = 0; k < number && outcome == DONE; ++k) outcome = get_number(&u->s, r[k], &values[k]);
  return said(u, outcome);
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference r[], size_t number, const fmi3Float64 values[], size_t size) {
  unit* u = instance;
  size_t k;
  int outcome = number == size ? DONE : UNKNOWN;
  for (k = 0; k < number && outcome == DONE; ++k) outcome = set_number(&u->s, r[k], values[k]);
  return said(u, outcome);
}

fmi3Status fmi3GetInt32(fmi3Instance instance, const fmi3ValueReference r[], size_t number, fmi3Int32 values[], size_t size) {
  unit* u = instance;
  size_t k;
  int outcome = number == size ? DONE : UNKNOWN, value = 0;
  for (k = 0; k < number && outcome == DONE; ++k) outcome = get_status(&u->s, r[k], &value), values[k] = (fmi3Int32)value;
  return said(u, outcome);
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 point, fmi3Float64 length, fmi3Boolean no_return, fmi3Boolean* event,
                      fmi3Boolean* terminate, fmi3Boolean* early, fmi3Float64* last) {
  unit* u = instance;
  (void)no_return, (void)point;
  *event = *terminate = *early = fmi3False;
  *last = (fmi3Float64)now(&u->s);
  if (!take_step(&u->s, length)) return failed(u, fmi3Error, WRONG_STEP);
  *last = (fmi3Float64)now(&u->s);
  return fmi3OK;
}

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState* state) {
  if (!*state) *state = malloc(sizeof(cycle_state));
  if (!*state) return fmi3Error;
  return memcpy(*state, &((unit*)instance)->s, sizeof(cycle_state)), fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState state) {
  return memcpy(&((unit*)instance)->s, state, sizeof(cycle_state)), fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState* state) {
  (void)instance;
  free(*state);
  *state = 0;
  return fmi3OK;
}
