/* @title@ on a board with CMSIS: the system tick sets the pace, one step per period. Put in your board's header, and the two functions
   that read a sample and write a command; `longest` then has the cycles of the processor that the longest step took. */

#ifndef BOARD_HEADER
#define BOARD_HEADER "stm32f7xx.h"
#endif
#include BOARD_HEADER

#include "@name@.h"

#define TICKS_PER_SECOND 1000
#define SECONDS_PER_UNIT 1 /* of @NAME@_PERIOD, which is in @unit@ */
#define TICKS ((unsigned long)(@NAME@_PERIOD * SECONDS_PER_UNIT * TICKS_PER_SECOND + 0.5))

void read_sample(@name@_inputs* in);          /* all but the time */
void write_command(const @name@_command* out);

static @name@_controller controller;
static volatile unsigned long due;
unsigned long longest;

void SysTick_Handler(void) {
  static unsigned long tick;
  if (++tick >= TICKS) tick = 0, ++due;
}

int main(void) {
  unsigned long cycle = 0;
  @name@_inputs in;
  @name@_command out;
  @name@_init(&controller);
  CoreDebug->DEMCR |= CoreDebug_DEMCR_TRCENA_Msk;
  DWT->CTRL |= DWT_CTRL_CYCCNTENA_Msk;
  SysTick_Config(SystemCoreClock / TICKS_PER_SECOND);
  for (;;) {
    unsigned long began, took;
    while (due == cycle) __WFI();
    cycle = due; /* cycles that were missed are made up for by the next step, from its time */
    read_sample(&in);
    in.time = (casadi_real)cycle * (casadi_real)@NAME@_PERIOD;
    began = DWT->CYCCNT;
    @name@_step(&controller, &in, &out);
    took = DWT->CYCCNT - began;
    if (took > longest) longest = took;
    write_command(&out);
  }
}
