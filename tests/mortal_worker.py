"""A worker for tests that doubles numbers: it dies once at the numbers it is told to, and whenever it gets a negative one."""

import json
import os
import signal
import sys
from pathlib import Path

opening = json.loads(sys.stdin.readline())
print(json.dumps(opening), flush=True)
for line in sys.stdin:
    number = json.loads(line)
    died = Path(opening["folder"]) / f"died_at_{number}"
    if number < 0 or (number in opening["deadly"] and not died.exists()):
        died.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    print(json.dumps(2 * number), flush=True)
