/* The controller behind a line of text, for a processor in the loop. A line in, a line out; numbers are the 16 hexadecimal digits of a double:

       h                      its name, and how many numbers a sample and a command have
       r                      begin anew: ok
       s NUMBER ... NUMBER    one cycle with a sample: the status, and the command

   With -DPROCESSOR it is a program over stdin and stdout, in place of main.c. On a board call serve with the two functions of its port. */

#include "@name@.h"

#include <string.h>

typedef unsigned long long word;

static @name@_controller c;
static int (*get)(void);
static void (*put)(int);

static void say(const char* text) {
  while (*text) put(*text++);
}

static void say_number(double value) {
  word bits;
  int k;
  memcpy(&bits, &value, sizeof bits);
  put(' ');
  for (k = 60; k >= 0; k -= 4) put("0123456789abcdef"[bits >> k & 15]);
}

static void say_whole(int value) {
  int unit = 1;
  while (value / unit >= 10) unit *= 10;
  put(' ');
  for (; unit; unit /= 10) put('0' + value / unit % 10);
}

static int last;

static int next(void) { return last = get(); }

/* The next byte after blanks. */
static int next_byte(void) {
  do next();
  while (last == ' ' || last == '\r');
  return last;
}

static int read_number(double* value) {
  word bits = 0;
  int k, byte = next_byte();
  for (k = 0; k < 16; ++k, byte = k < 16 ? next() : 0) {
    int digit = byte >= '0' && byte <= '9' ? byte - '0' : byte >= 'a' && byte <= 'f' ? byte - 'a' + 10 : -1;
    if (digit < 0) return 0;
    bits = bits << 4 | (word)digit;
  }
  memcpy(value, &bits, sizeof bits);
  return 1;
}

static void step(void) {
  @name@_inputs in;
  @name@_command out;
  casadi_real *sample = (casadi_real*)&in, *command = (casadi_real*)&out;
  int k, status;
  for (k = 0; k < @NAME@_INPUTS; ++k) {
    double value;
    if (!read_number(&value)) {
      say("? a sample has too few numbers");
      return;
    }
    sample[k] = (casadi_real)value;
  }
  status = (int)@name@_step(&c, &in, &out);
  say("s");
  say_whole(status);
  for (k = 0; k < @NAME@_COMMANDS; ++k) say_number((double)command[k]);
}

/* Answer lines until the bytes end. */
void serve(int (*from)(void), void (*to)(int));
void serve(int (*from)(void), void (*to)(int)) {
  int byte;
  get = from, put = to;
  @name@_init(&c);
  while ((byte = next_byte()) >= 0) {
    if (byte == '\n') continue;
    if (byte == 'h') {
      say("h @name@");
      say_whole(@NAME@_INPUTS);
      say_whole(@NAME@_COMMANDS);
    } else if (byte == 'r') {
      @name@_init(&c);
      say("r");
    } else if (byte == 's') {
      step();
    } else {
      say("? expected h, r or s");
    }
    while (last != '\n' && last >= 0) next();
    put('\n');
  }
}

#ifdef PROCESSOR
#include <stdio.h>
static void to_output(int byte) {
  putchar(byte);
  if (byte == '\n') fflush(stdout);
}
int main(void) {
  serve(getchar, to_output);
  return 0;
}
#endif
