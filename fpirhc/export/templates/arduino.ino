/* @title@ on an Arduino: one step per period; the longest step so far is told beside the period. Write the two functions. */

#include <@name@.h>

/* Microseconds of @NAME@_PERIOD, which is in @unit@. */
@pace@

static @name@_controller controller;
static @name@_inputs in;
static @name@_command out;
static unsigned long due, cycle, longest;

void read_sample(@name@_inputs* in) { (void)in; }           /* all but the time */
void write_command(const @name@_command* out) { (void)out; }

void setup() {
  Serial.begin(115200);
  @name@_init(&controller);
  due = micros();
}

void loop() {
  unsigned long begun = micros(), took;
  if ((long)(begun - due) < 0) return;
  due += TICKS;
  if (cycle > @NAME@_CYCLES) { /* a float resolves no later time; begin anew where it suits your task better */
    @name@_reset(&controller);
    cycle = 0;
  }
  in.time = cycle++ * @NAME@_PERIOD;
  read_sample(&in);
  @name@_step(&controller, &in, &out);
  write_command(&out);
  took = micros() - begun;
  if (took > longest) {
    longest = took;
    Serial.print("longest step, us: ");
    Serial.print(longest);
    Serial.print(longest > TICKS ? ", TOO LONG for a period of " : ", of a period of ");
    Serial.println(TICKS);
  }
}
