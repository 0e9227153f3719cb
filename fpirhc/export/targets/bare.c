/* @title@, without gate and watch. Made by fpirhc; see @name@.h. */

#include "@name@.h"

#include <math.h>
#include <string.h>

@tables@

@declaration@

enum { STATUS = @status@, COMMAND = @command@ }; /* in the trace */

void @name@_init(@name@_controller* c) {
  memset(c, 0, sizeof *c);
@init@
  @name@_reset(c);
}

void @name@_reset(@name@_controller* c) {
  memcpy(&c->memory, START, sizeof START);
  memset(&c->trace, 0, sizeof c->trace);
}

/* Nothing is checked: a sample that is no number makes the memory one, until the next reset. */
@name@_status @name@_step(@name@_controller* c, const @name@_inputs* in, @name@_command* out) {
  casadi_real *trace = (casadi_real*)&c->trace, *command = (casadi_real*)out;
  int k, failed;
@bind@
  c->res[0] = (casadi_real*)&c->next;
  c->res[1] = trace;
  c->res[2] = command;
  failed = @name@_raw(c->arg, c->res, c->iw, c->w, 0);
  if (!failed) c->memory = c->next;
  for (k = 0; k < @NAME@_COMMANDS; ++k) {
    casadi_real u = failed ? trace[COMMAND + k] : command[k];
    command[k] = trace[COMMAND + k] = u < LEAST[k] ? LEAST[k] : u > MOST[k] ? MOST[k] : u;
  }
  if (failed) trace[STATUS] = @NAME@_SOLVER_FAILED;
  return (@name@_status)trace[STATUS];
}
