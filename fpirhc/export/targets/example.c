/* @title@ on a board with CMSIS: the system tick sets the pace, one step per period. Put in your board's header, and the two functions
   that read a sample and write a command; `longest` then has the cycles of the processor that the longest step took. */

#ifndef BOARD_HEADER
#define BOARD_HEADER "stm32f7xx.h"
#endif
#include BOARD_HEADER

#include <stdint.h>

#include "@name@.h"

/* System ticks in @NAME@_PERIOD, which is in @unit@, and the seconds of one. */
@pace@

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
  unsigned long cycle = 0, begun = 0;
  @name@_inputs in;
  @name@_command out;
  @name@_init(&controller);
  CoreDebug->DEMCR |= CoreDebug_DEMCR_TRCENA_Msk;
  DWT->CTRL |= DWT_CTRL_CYCCNTENA_Msk;
  SysTick_Config((uint32_t)(SystemCoreClock * TICK + 0.5));
  for (;;) {
    unsigned long began, took;
    while (due == cycle) __WFI();
    cycle = due; /* cycles that were missed are made up for by the next step, from its time */
    read_sample(&in);
    if (cycle - begun > @NAME@_CYCLES) { /* no later time is resolved, which matters in float; begin anew where it suits you better */
      @name@_reset(&controller);
      begun = cycle;
    }
    in.time = (casadi_real)(cycle - begun) * (casadi_real)@NAME@_PERIOD;
    began = DWT->CYCCNT;
    @name@_step(&controller, &in, &out);
    took = DWT->CYCCNT - began;
    if (took > longest) longest = took;
    write_command(&out);
  }
}
