#include "fmi2Functions.h"

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
  (void)no_return, (void)point;
  return take_step(&u->s, length) ? fmi2OK : failed(u, fmi2Error, WRONG_STEP);
}

fmi2Status fmi2GetFMUstate(fmi2Component instance, fmi2FMUstate* state) {
  if (!*state) *state = malloc(sizeof(cycle_state));
  if (!*state) return fmi2Error;
  return memcpy(*state, &((unit*)instance)->s, sizeof(cycle_state)), fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component instance, fmi2FMUstate state) {
  return memcpy(&((unit*)instance)->s, state, sizeof(cycle_state)), fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component instance, fmi2FMUstate* state) {
  (void)instance;
  free(*state);
  *state = 0;
  return fmi2OK;
}

/* A state is not written as bytes. */
fmi2Status fmi2SerializeFMUstate(fmi2Component instance, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
  (void)instance, (void)state, (void)bytes, (void)size;
  return fmi2Error;
}
