"""A library for the Arduino IDE on a board of 16 MHz in simavr: its commands, and how long its longest step takes."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import numpy as np

CLOCK = 16e6  # Hz
_MAIN = """
#include <stdio.h>
#include <string.h>
#include <avr/io.h>
#include <avr/interrupt.h>
#include <avr/pgmspace.h>
#include <avr/sleep.h>
#include "@name@.h"
static const float SAMPLES[][@inputs@] PROGMEM = {@rows@};
static @name@_controller c;
static volatile unsigned turns; /* of the counter, which has 16 bits */
ISR(TIMER1_OVF_vect) { ++turns; }
static unsigned long now(void) {
  unsigned long at;
  cli();
  at = TCNT1;
  if (TIFR1 & 1 << TOV1 && at < 0x8000) at += 0x10000;
  at += (unsigned long)turns << 16;
  sei();
  return at;
}
static int put(char one, FILE* to) { (void)to; while (!(UCSR0A & 1 << UDRE0)) {} UDR0 = one; return 0; }
static FILE out = FDEV_SETUP_STREAM(put, 0, _FDEV_SETUP_WRITE);
int main(void) {
  unsigned k, j;
  UCSR0B = 1 << TXEN0, TCCR1B = 2, TIMSK1 = 1 << TOIE1; /* clocks in eights */
  stdout = &out;
  @name@_init(&c);
  for (k = 0; k < sizeof SAMPLES / sizeof *SAMPLES; ++k) {
    @name@_inputs in;
    @name@_command command;
    unsigned long took;
    memcpy_P(&in, SAMPLES[k], sizeof in);
    took = now();
    @name@_step(&c, &in, &command);
    took = now() - took;
    printf("= %lu", took);
    for (j = 0; j < sizeof command / sizeof(float); ++j) printf(" %08lx", ((unsigned long*)&command)[j]);
    printf("\\n");
  }
  cli();
  sleep_enable();
  sleep_cpu();
}
"""


def answered(folder: Path, name: str, rows: np.ndarray, processor: str = "atmega328p") -> tuple[np.ndarray, float]:
    """Return the commands of a library for recorded samples, a row per cycle, and the longest step in s.

    Args:
        folder: that the target arduino has written.
        name: prefix of the controller.
        rows: samples, a row per cycle.
        processor: of the board; that of an Uno by default.
    """
    table = ",\n".join("{" + ", ".join(repr(float(np.float32(v))) for v in row) + "}" for row in rows)
    words = {"name": name, "inputs": str(rows.shape[1]), "rows": table}
    (folder / "main.c").write_text(re.sub(r"@(\w+)@", lambda m: words[m[1]], _MAIN))
    flags = [
        f"-mmcu={processor}",
        "-std=gnu99",
        "-Os",
        "-ffunction-sections",
        "-Wl,--gc-sections",
        "-Wl,--relax",
        f"-I{folder / 'src'}",
    ]
    sources = [*map(str, sorted((folder / "src").glob("*.c"))), str(folder / "main.c")]
    program = str(folder / "program.elf")
    subprocess.run(["avr-gcc", *flags, *sources, "-lm", "-o", program], check=True)
    command = ["simavr", "-m", processor, "-f", f"{CLOCK:.0f}", program]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    text = re.sub(r"\x1b\[[0-9;]*m", "", done.stdout + done.stderr).replace(".\n", "\n")
    said = [line.split()[1:] for line in text.splitlines() if line.startswith("=")]
    if len(said) != len(rows):
        msg = f"simavr: {len(said)} answers to {len(rows)} samples: {text[-500:]}"
        raise RuntimeError(msg)
    bits = np.array([[int(word, 16) for word in line[1:]] for line in said], dtype=np.uint32)
    return bits.view(np.float32), max(int(line[0]) for line in said) * 8 / CLOCK
