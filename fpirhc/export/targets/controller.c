/* @title@. Made by fpirhc; see @name@.h. */

#include "@name@.h"

#include <math.h>
#include <string.h>

@tables@

@declaration@

enum { BEFORE = @before@, HELD = @held@, SKIPPED = @skipped@ };                /* in the memory */
enum { STATUS = @status@, SKIPPED_NOW = @skipped_now@, COMMAND = @command@ };  /* in the trace */
enum { FAILS = @fails@, CHANGES = @changes@ }; /* whether a loop in it can fail, and whether limits may be changed */

/* One cycle; returns whether a solver failed, and then the memory stays. Numbers are copied one by one: small processors copy bytes
   in more time. */
static int cycle(@name@_controller* c, const @name@_inputs* in, casadi_real* command) {
  casadi_real* to = (casadi_real*)&c->memory;
  const casadi_real* from = (const casadi_real*)&c->next;
  const casadi_real* end = from + @NAME@_MEMORY;
@bind@
  c->res[0] = (casadi_real*)&c->next;
  c->res[1] = (casadi_real*)&c->trace;
  c->res[2] = command;
  if (@name@_raw(c->arg, c->res, c->iw, c->w, 0)) return 1;
  while (from != end) *to++ = *from++;
  return 0;
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
  casadi_real *memory = (casadi_real*)&c->memory, *command = (casadi_real*)out, before = memory[BEFORE];
  long missed = in->time - before > (casadi_real)1.5 * PERIOD ? missed_cycles(in->time, before) : 0;
  long dropped = missed > MISSED ? missed - MISSED : 0, k;
  for (k = dropped; k < missed; ++k) {
    @name@_inputs lost = *in;
    ((casadi_real*)&lost)[@first@] = (casadi_real)NAN;
    lost.time = before + (casadi_real)(k + 1) * PERIOD;
    if (cycle(c, &lost, command) && FAILS) return hold(c, in->time, command);
  }
  if (dropped) memory[SKIPPED] += (casadi_real)dropped;
  if (cycle(c, in, command) && FAILS) return hold(c, in->time, command);
  if (CHANGES) clip(c, command);
  return (@name@_status)((casadi_real*)&c->trace)[STATUS];
}
@set@
