"""A library folder of the Arduino IDE: its sources compute in float, and a step's time is told beside the period."""

import subprocess

import pytest
from helpers.exports import COMPILERS, STRICT, exported

CASE = ("two_mass", "CTC+FPI (eq 6)")


@pytest.mark.skipif(not COMPILERS, reason="no C compiler")
def test_an_arduino_library_replays_in_float(tmp_path):
    """No warning, commands to a thousandth of those in double with faults among the samples; header and sketch have one name."""
    exported(tmp_path / "board", *CASE, "arduino"), exported(tmp_path / "c", *CASE)
    assert "includes=arm.h" in (tmp_path / "board" / "library.properties").read_text().splitlines()
    sketch = (tmp_path / "board" / "examples" / "arm" / "arm.ino").read_text()
    assert "#include <arm.h>" in sketch
    assert "@" not in sketch
    assert "TOO LONG for a period of" in sketch
    src = tmp_path / "board" / "src"
    (tmp_path / "type.c").write_text(
        '#define Q1 17\n#include "arm.h"\nextern char is_float[sizeof(((arm_command*)0)->Q1) == 4 ? 1 : -1];\n'
    )
    (tmp_path / "main.c").write_text((tmp_path / "c" / "main.c").read_text())  # apart from the header in double
    files = [*src.glob("*.c"), tmp_path / "type.c", tmp_path / "main.c"]
    program = tmp_path / "replay"
    command = [COMPILERS[0], *STRICT, "-O2", "-ffp-contract=off", f"-I{src}", *map(str, files), "-lm"]
    subprocess.run([*command, "-o", str(program)], check=True, cwd=tmp_path)
    done = subprocess.run([program, tmp_path / "c" / "samples.bin"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "2000 cycles" in done.stdout
