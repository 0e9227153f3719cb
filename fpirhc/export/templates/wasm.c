/* @title@ as a WebAssembly module: one controller, and where its numbers are. Made by fpirhc. */

#include "@name@.h"

#define EXPORT(name) __attribute__((export_name(name)))

static @name@_controller c;
static @name@_inputs in;
static @name@_command out;

EXPORT("init") void begin(void) { @name@_init(&c); }
EXPORT("reset") void again(void) { @name@_reset(&c); }
EXPORT("step") int step(void) { return (int)@name@_step(&c, &in, &out); }
EXPORT("inputs") void* inputs(void) { return &in; }
EXPORT("command") void* command(void) { return &out; }
EXPORT("memory_of_controller") void* memory(void) { return &c.memory; }
EXPORT("trace") void* trace(void) { return &c.trace; }
@data@
