/* Replays the recorded cycles of samples.bin, faults included, and compares every answer with what it was in Python:

       replay samples.bin

   Numbers are compared by their bits, with one NaN for all. In another number type, and where the file
   says that bits do not count, only the commands are compared, to 1e-9 of their size; in float to 1e-3, and before the first
   outlier alone, in which float has no digits of what follows. */

#include "@name@.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

typedef unsigned long long word; /* at least 64 bits */

enum { OUTLIER = 40 }; /* the first cycle with one */

static word digest(const casadi_real* values, int size) {
  word total = 0xcbf29ce484222325u, bits;
  int k;
  for (k = 0; k < size; ++k) {
    double value = (double)values[k];
    memcpy(&bits, &value, sizeof value);
    if (value != value) bits = 0x7ff8000000000000u;
    total = (total ^ bits) * 0x100000001b3u & 0xffffffffffffffffu;
  }
  return total;
}

int main(int argc, char** argv) {
  static @name@_controller c;
  FILE* file = fopen(argc > 1 ? argv[1] : "samples.bin", "rb");
  int head[4], k, j, statuses[@NAME@_STATUSES] = {0};
  long commands = 0, memories = 0, traces = 0;
  double worst = 0, largest = 0; /* of the commands */
  word answers = 0xcbf29ce484222325u;
  if (!file || fread(head, sizeof(int), 4, file) != 4 || head[1] != @NAME@_INPUTS || head[2] != @NAME@_COMMANDS) {
    fprintf(stderr, "expected the file samples.bin of this controller\n");
    return 2;
  }
  if (sizeof(casadi_real) != sizeof(double)) head[3] = 0;
  @name@_init(&c);
  for (k = 0; k < head[0]; ++k) {
    double sample[@NAME@_INPUTS], damaged, expected[@NAME@_COMMANDS];
    word hashes[2];
    casadi_real given[@NAME@_INPUTS], *answer;
    @name@_inputs in;
    @name@_command out;
    @name@_status status;
    if (fread(sample, sizeof sample, 1, file) != 1 || fread(&damaged, sizeof damaged, 1, file) != 1 ||
        fread(expected, sizeof expected, 1, file) != 1 || fread(hashes, sizeof hashes, 1, file) != 1) {
      fprintf(stderr, "the file ends in cycle %d\n", k);
      return 2;
    }
    for (j = 0; j < @NAME@_INPUTS; ++j) given[j] = (casadi_real)sample[j];
    memcpy(&in, given, sizeof in);
    if (damaged >= 0) ((casadi_real*)&c.memory)[(int)damaged] = (casadi_real)NAN;
    status = @name@_step(&c, &in, &out);
    if (status < @NAME@_STATUSES) ++statuses[status];
    answer = (casadi_real*)&out;
    for (j = 0; j < @NAME@_COMMANDS; ++j) {
      double value = (double)answer[j], apart = fabs(value - expected[j]);
      word bits = 0;
      memcpy(&bits, &value, sizeof value);
      answers = (answers ^ bits) * 0x100000001b3u & 0xffffffffffffffffu;
      commands += memcmp(&value, &expected[j], sizeof value) != 0;
      if (!(apart <= worst) && (sizeof(casadi_real) == sizeof(double) || k < OUTLIER)) worst = apart;
      if (fabs(expected[j]) > largest) largest = fabs(expected[j]);
    }
    memories += digest((casadi_real*)&c.memory, @NAME@_MEMORY) != hashes[0];
    traces += digest((casadi_real*)&c.trace, @NAME@_TRACE) != hashes[1];
  }
  fclose(file);
  if (!head[3]) memories = traces = 0, commands = !(worst <= (sizeof(casadi_real) < 8 ? 1e-3 : 1e-9) * largest);
  printf("%d cycles: command off by at most %.3g of %.3g; cycles that differ in a bit: command %ld, memory %ld, trace %ld\n", head[0],
         worst, largest, commands, memories, traces);
  printf("statuses:");
  for (j = 0; j < @NAME@_STATUSES; ++j)
    if (statuses[j]) printf(" %d (%d cycles)", j, statuses[j]);
  printf("\nanswers %016llx", answers);
  printf("\n%lu bytes of a controller\n", (unsigned long)sizeof c);
  return commands || memories || traces;
}
