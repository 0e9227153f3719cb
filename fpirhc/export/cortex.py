"""A Cortex-M board without the board: runs an exported image in Unicorn, with its console on stdin and stdout.

`python -m fpirhc.export.cortex IMAGE` answers lines as `processor.c` says. Unicorn has the instructions and floating-point unit of
the processor; time, interrupts and peripherals are not there. At the end it prints the instructions of a step: mean and most.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from fpirhc.errors import FpirhcError, InvalidValue, package

_MEMORY = ((0x00000000, 4 << 20), (0x20000000, 4 << 20), (0xE000E000, 1 << 12))  # flash, RAM, control registers
_OPEN, _WRITE, _READ, _EXIT = 0x01, 0x05, 0x06, 0x18  # operations of semihosting
_INPUT, _OUTPUT = 1, 2
_ALLOCATED = 2  # flag of a section that lies in memory


class Image:
    """A program for a Cortex-M as an ELF file.

    Raises:
        InvalidValue: it cannot be read, or is no whole 32-bit ELF file for ARM.
    """

    def __init__(self, of: Path | bytes) -> None:
        path = of if isinstance(of, Path) else Path("an image")
        try:
            self.bytes = of.read_bytes() if isinstance(of, Path) else of
            if self.bytes[:6] != b"\x7fELF\x01\x01" or self.bytes[18:20] != b"\x28\x00":
                raise ValueError
            self._read()
        except OSError as error:
            raise InvalidValue(f"'{path}' cannot be read: {error.strerror}") from None
        except (IndexError, ValueError, struct.error):
            what = f"'{path}' is no program for a Cortex-M, or not all of one"
            raise InvalidValue(f"{what}: expected the .elf of `--to cortex-m`") from None

    def _read(self) -> None:
        head = struct.unpack_from("<16sHHIIIIIHHHHHH", self.bytes)
        segments = [struct.unpack_from("<8I", self.bytes, head[5] + 32 * k) for k in range(head[10])]
        self.segments = [(s[3], self.bytes[s[1] : s[1] + s[4]]) for s in segments if s[0] == 1 and s[4]]
        sections = [struct.unpack_from("<10I", self.bytes, head[6] + 40 * k) for k in range(head[12])]
        self.places = [(s[3], s[5]) for s in sections if s[2] & _ALLOCATED]
        self.symbols = {}
        for table in (s for s in sections if s[1] == 2):
            names = sections[table[6]][4]
            for at in range(table[4], table[4] + table[5], 16):
                name, value, size = struct.unpack_from("<III", self.bytes, at)
                text = self.bytes[names + name : self.bytes.index(b"\0", names + name)].decode()
                self.symbols[text] = (value & ~1, size)

    def size(self, start: int) -> int:
        """Return the bytes that lie in the memory that begins there."""
        return sum(size for at, size in self.places if at >> 28 == start >> 28)


class Board:
    """An image in a processor, with a console.

    Args:
        counted: name of the function whose instructions are counted.

    Raises:
        NotInstalled: Unicorn is not installed.
    """

    def __init__(self, image: Image, source: BinaryIO, to: BinaryIO, counted: str = "") -> None:
        unicorn = package("unicorn", "cortex", "a Cortex-M without a board")
        self._registers = package("unicorn.arm_const", "cortex")
        self._source, self._to, self._sizes = source, to, dict[tuple[int, int], int]()
        self._places = image.places
        self._counted, self._back, self._now = image.symbols.get(counted, (-1, 0))[0], -1, 0
        self.counts: list[int] = []
        self._unit: Any = unicorn.Uc(unicorn.UC_ARCH_ARM, unicorn.UC_MODE_THUMB)
        self._unit.ctl_set_cpu_model(self._registers.UC_CPU_ARM_CORTEX_M7)
        for start, size in _MEMORY:
            self._unit.mem_map(start, size)
        for start, contents in image.segments:
            self._unit.mem_write(start, contents)
        self._stack, self._begin = struct.unpack("<2I", self._unit.mem_read(0, 8))
        self._unit.hook_add(unicorn.UC_HOOK_INTR, self._asked)
        if self._counted >= 0:
            self._unit.hook_add(unicorn.UC_HOOK_BLOCK, self._block)

    def run(self) -> None:
        """Run from reset to the program's end."""
        self._unit.reg_write(self._registers.UC_ARM_REG_SP, self._stack)
        self._unit.emu_start(self._begin, 0xFFFFFFFE)

    def stack(self) -> int:
        """Return the bytes of stack that were written: memory that no one has written is zero."""
        behind = max(at + size for at, size in self._places if at >> 28 == self._stack >> 28)
        return len(bytes(self._unit.mem_read(behind, self._stack - behind)).lstrip(b"\0"))

    def _block(self, unit: Any, address: int, size: int, _: object) -> None:
        """Count the instructions between the entry of the counted function and its return."""
        if address == self._counted and self._back < 0:
            self._back, self._now = unit.reg_read(self._registers.UC_ARM_REG_LR) & ~1, 0
        elif address == self._back:
            self._back = -1
            self.counts.append(self._now)
        if self._back >= 0:
            key = (address, size)
            if key not in self._sizes:
                self._sizes[key] = _instructions(bytes(unit.mem_read(address, size)))
            self._now += self._sizes[key]

    def _asked(self, unit: Any, number: int, _: object) -> None:
        """Answer an operation of semihosting; every other exception ends the run."""
        operation, at = (unit.reg_read(r) for r in (self._registers.UC_ARM_REG_R0, self._registers.UC_ARM_REG_R1))
        answers: dict[int, Callable[[Any, int], int]] = {_OPEN: self._open, _WRITE: self._write, _READ: self._read}
        place = unit.reg_read(self._registers.UC_ARM_REG_PC)
        if number != 7 or operation not in answers:
            unit.emu_stop()
            return
        unit.reg_write(self._registers.UC_ARM_REG_R0, answers[operation](unit, at))
        unit.reg_write(self._registers.UC_ARM_REG_PC, (place + 2) | 1)

    def _open(self, unit: Any, at: int) -> int:
        return _OUTPUT if struct.unpack("<3I", unit.mem_read(at, 12))[1] >= 4 else _INPUT

    def _read(self, unit: Any, at: int) -> int:
        _, to, size = struct.unpack("<3I", unit.mem_read(at, 12))
        received = self._source.read(size)
        unit.mem_write(to, received)
        return size - len(received)

    def _write(self, unit: Any, at: int) -> int:
        _, start, size = struct.unpack("<3I", unit.mem_read(at, 12))
        self._to.write(unit.mem_read(start, size))
        self._to.flush()
        return 0


def _instructions(code: bytes) -> int:
    """Number of Thumb-2 instructions: of four bytes where the first five bits are 11101, 11110 or 11111."""
    at = number = 0
    while at < len(code):
        at += 4 if code[at + 1] >> 3 >= 0b11101 else 2
        number += 1
    return number


def main(arguments: list[str]) -> None:
    """Run the image of the command line.

    Raises:
        SystemExit: there is no image, or what it lacks.
    """
    if len(arguments) != 1:
        raise SystemExit("usage: python -m fpirhc.export.cortex IMAGE, the .elf of `fpirhc export --to cortex-m`")
    try:
        program = Image(Path(arguments[0]))
        step = next((name for name in program.symbols if name.endswith("_step")), "")
        board = Board(program, sys.stdin.buffer, sys.stdout.buffer, step)
    except FpirhcError as error:
        raise SystemExit(str(error)) from None
    board.run()
    if board.counts:
        print(f"instructions of a step: mean {np.mean(board.counts):.0f}, most {max(board.counts)}", file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1:])
