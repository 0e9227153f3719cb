/* @title@ for callers that know arrays alone. Made by fpirhc; the order of the numbers is that of layout.json.

   The caller allocates @name@_size() bytes for each controller, aligned as a double is. */

#include "@name@.h"

#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif

EXPORT int @name@_size(void);
EXPORT void @name@_begin(void* controller);
EXPORT int @name@_cycle(void* controller, const double* sample, double* command);
EXPORT int @name@_change(void* controller, int setting, double value);

EXPORT int @name@_size(void) { return (int)sizeof(@name@_controller); }

EXPORT void @name@_begin(void* controller) { @name@_init((@name@_controller*)controller); }

/* One control cycle: the time and the sample in, the command out; the status of the cycle is returned. */
EXPORT int @name@_cycle(void* controller, const double* sample, double* command) {
  @name@_inputs in;
  @name@_command out;
  casadi_real *given = (casadi_real*)&in, *answer = (casadi_real*)&out;
  int k, status;
  for (k = 0; k < @NAME@_INPUTS; ++k) given[k] = sample[k];
  status = (int)@name@_step((@name@_controller*)controller, &in, &out);
  for (k = 0; k < @NAME@_COMMANDS; ++k) command[k] = answer[k];
  return status;
}

/* Change a setting, counted from 0 in the order of bounds in layout.json: 1, or 0 where it is refused. */
EXPORT int @name@_change(void* controller, int setting, double value) {
@change@
}
