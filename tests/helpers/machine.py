"""What this machine has."""

import os
import shutil

import pytest

_ASKED = os.environ.get("FPIRHC_CC", "")
_NAMES = [_ASKED] if _ASKED else [os.environ.get("CC", ""), "cc", "gcc", "clang"]
COMPILER = next((path for name in _NAMES if name and (path := shutil.which(name))), None)
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="this machine has no C compiler")
