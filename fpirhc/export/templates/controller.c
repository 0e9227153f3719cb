/* @title@. Made by fpirhc; see @name@.h. */

#include "@name@.h"

#include <math.h>
#include <string.h>

@tables@

@declaration@

enum { BEFORE = @before@, HELD = @held@, SKIPPED = @skipped@, MISSING = @missing@ }; /* in the memory */
enum { STATUS = @status@, SKIPPED_NOW = @skipped_now@, COMMAND = @command@ };  /* in the trace */
enum { FAILS = @fails@, CHANGES = @changes@ }; /* whether a loop in it can fail, and whether limits may be changed */

/* One cycle, whose memory is `next` until it is kept; returns whether a solver failed. */
static int cycle(@name@_controller* c, const @name@_inputs* in, casadi_real* command) {
@bind@
  c->res[0] = (casadi_real*)&c->next;
  c->res[1] = (casadi_real*)&c->trace;
  c->res[2] = command;
  return @name@_raw(c->arg, c->res, c->iw, c->w, 0);
}

/* Numbers are copied one by one: small processors copy bytes in more time. */
static void keep(@name@_controller* c) {
  casadi_real* to = (casadi_real*)&c->memory;
  const casadi_real* from = (const casadi_real*)&c->next;
  const casadi_real* end = from + @NAME@_MEMORY;
  while (from != end) *to++ = *from++;
}

/* Sample i of the missing ones, on the polynomial through this one and the last good ones, newest first. */
static void between(const casadi_real* good, const casadi_real* now, long i, long missing, casadi_real* out) {
  int m, j, k;
  for (m = 0; m <= SAMPLES; ++m) { /* this one, and then the others */
    const casadi_real* value = m ? good + (m - 1) * @NAME@_INPUTS : now;
    casadi_real own = (casadi_real)(m ? 1 - m : missing + 1), weight = 1;
    for (j = 0; j <= SAMPLES; ++j) {
      casadi_real other = (casadi_real)(j < SAMPLES ? -j : missing + 1);
      if (other != own) weight *= ((casadi_real)i - other) / (own - other);
    }
    for (k = 0; k < @NAME@_INPUTS; ++k) /* what is no sample, as a set-point, is that of now */
      out[k] = GOOD[k] < 0 ? now[k] : m ? out[k] + weight * value[k] : weight * value[k];
  }
}

/* Missing cycles, run afterwards, and this one; what acted in them is the command in force. Returns whether a solver failed. */
static int replay(@name@_controller* c, const @name@_inputs* in, casadi_real* command, long missing) {
  casadi_real *memory = (casadi_real*)&c->memory, good[SAMPLES * @NAME@_INPUTS], kept[STAY];
  casadi_real before[FAILS ? @NAME@_MEMORY : 1]; /* to go back to, where a solver fails */
  const int *places = missing <= BRIDGED ? KEPT : STAYS;
  int k, failed = 0, some = missing <= BRIDGED ? KEPTS : STAY;
  long i;
  for (k = 0; k < SAMPLES * @NAME@_INPUTS; ++k) good[k] = GOOD[k] < 0 ? 0 : memory[GOOD[k]];
  for (k = 0; k < some; ++k) kept[k] = memory[places[k]];
  for (k = 0; FAILS && k < @NAME@_MEMORY; ++k) before[k] = memory[k];
  memory[BEFORE] = -FINITE;
  for (i = missing <= BRIDGED || missing < FILLS ? 1 : missing - FILLS + 1; i <= missing && !failed; ++i) {
    @name@_inputs line;
    between(good, (const casadi_real*)in, i, missing, (casadi_real*)&line);
    line.time = in->time - (casadi_real)(missing + 1 - i) * PERIOD;
    failed = cycle(c, &line, command) && FAILS;
    keep(c);
    for (k = 0; k < some; ++k) memory[places[k]] = kept[k];
  }
  failed = failed || (cycle(c, in, command) && FAILS);
  for (k = 0; failed && k < @NAME@_MEMORY; ++k) memory[k] = before[FAILS ? k : 0];
  return failed;
}

/* Cycles between two steps, whose samples are missing; 0 where the later step is the next cycle, or cannot follow the other. */
static long missed_cycles(casadi_real time, casadi_real before) {
  casadi_real cycles = (time - before) / PERIOD;
  return before > -FINITE / 2 && cycles >= (casadi_real)1.5 && cycles <= LONGEST ? lrint(cycles) - 1 : 0;
}

/* After a solver that failed: the last command, and the memory as it was. The next step makes up for this cycle. */
static @name@_status hold(@name@_controller* c, casadi_real time, casadi_real* command) {
  casadi_real *memory = (casadi_real*)&c->memory, *trace = (casadi_real*)&c->trace;
  long missing = missed_cycles(time + PERIOD, memory[BEFORE]);
  int k;
  for (k = 0; k < @NAME@_MEMORY; ++k)
    if (!(memory[k] - memory[k] == 0)) memory[k] = START[k];
  memory[SKIPPED] += missing == 0;
  for (k = 0; k < @NAME@_COMMANDS; ++k) command[k] = trace[COMMAND + k] = memory[HELD + k];
  trace[STATUS] = @NAME@_SOLVER_FAILED;
  trace[SKIPPED_NOW] = memory[SKIPPED] + (casadi_real)missing;
  return @NAME@_SOLVER_FAILED;
}

/* The last clip, to the limits of the build, whatever the settings are. */
static void clip(@name@_controller* c, casadi_real* command) {
  casadi_real *memory = (casadi_real*)&c->memory, *trace = (casadi_real*)&c->trace;
  int k;
  for (k = 0; k < @NAME@_COMMANDS; ++k) {
    casadi_real u = command[k];
    if (u < LEAST[k]) u = LEAST[k];
    if (u > MOST[k]) u = MOST[k];
    if (u < command[k] || u > command[k]) command[k] = memory[HELD + k] = trace[COMMAND + k] = u;
  }
}

void @name@_init(@name@_controller* c) {
  memset(c, 0, sizeof *c);
@init@
  @name@_reset(c);
}

void @name@_reset(@name@_controller* c) {
  memcpy(&c->memory, START, sizeof START);
  memset(&c->trace, 0, sizeof c->trace);
}

@name@_status @name@_step(@name@_controller* c, const @name@_inputs* in, @name@_command* out) {
  casadi_real *memory = (casadi_real*)&c->memory, *trace = (casadi_real*)&c->trace, *command = (casadi_real*)out;
  long missed = in->time - memory[BEFORE] > (casadi_real)1.5 * PERIOD ? missed_cycles(in->time, memory[BEFORE]) : 0, missing;
  memory[SKIPPED] += (casadi_real)missed;
  if (missed) memory[BEFORE] = in->time - PERIOD;
  if (memory[MISSING] > (casadi_real)-0.5) memory[MISSING] += (casadi_real)missed;
  missing = memory[MISSING] > (casadi_real)0.5 && memory[MISSING] <= MOST_MISSING ? lrint(memory[MISSING]) : 0;
  if (cycle(c, in, command) && FAILS) return hold(c, in->time, command);
  if (missing && ((casadi_real*)&c->next)[MISSING] == 0) {
    if (replay(c, in, command, missing)) return hold(c, in->time, command);
    if (trace[STATUS] == 0) trace[STATUS] = missing <= BRIDGED ? @NAME@_BRIDGED : @NAME@_SETTLING;
  }
  keep(c);
  if (CHANGES) clip(c, command);
  return (@name@_status)trace[STATUS];
}
@set@
