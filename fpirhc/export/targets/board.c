/* The smallest Cortex-M program: vectors, start, and serve over semihosting, as QEMU, a debugger or fpirhc.export.cortex understand it.
   On a board replace the two functions of the port, or take example.c. */

typedef unsigned int word;

extern word TOP_OF_STACK[], BSS_BEGIN[], BSS_END[], DATA_BEGIN[], DATA_END[], DATA_FROM[];
void serve(int (*from)(void), void (*to)(int));
void reset(void);
static void stop(void);

__attribute__((section(".vectors"), used)) static void* const VECTORS[16] = {
    TOP_OF_STACK, (void*)reset, (void*)stop, (void*)stop, (void*)stop, (void*)stop, (void*)stop};

static word host(word operation, const void* argument) {
  register word r0 __asm__("r0") = operation;
  register const void* r1 __asm__("r1") = argument;
  __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
  return r0;
}

static word open_console(word mode) {
  struct {
    const char* name;
    word mode, size;
  } console = {":tt", mode, 3};
  return host(0x01, &console);
}

static word in, out;

static int get(void) {
  unsigned char byte;
  struct {
    word file;
    void* to;
    word size;
  } one = {in, &byte, 1};
  return host(0x06, &one) == 0 ? byte : -1;
}

static void put(int byte) {
  static unsigned char line[1024];
  static word size;
  line[size++] = (unsigned char)byte;
  if (byte == '\n' || size == sizeof line) {
    struct {
      word file;
      void* from;
      word size;
    } all = {out, line, size};
    host(0x05, &all);
    size = 0;
  }
}

static void stop(void) {
  for (;;) host(0x18, (void*)0x20026);
}

void reset(void) {
  word *to, *from = DATA_FROM;
  *(volatile word*)0xe000ed88 |= 0xfu << 20; /* the unit for floating point */
  __asm__ volatile("dsb\n isb" ::: "memory");
  for (to = DATA_BEGIN; to < DATA_END; ++to) *to = *from++;
  for (to = BSS_BEGIN; to < BSS_END; ++to) *to = 0;
  in = open_console(0), out = open_console(4);
  serve(get, put);
  stop();
}
