"""Numbers in sentences are written as people write them."""

from __future__ import annotations

import pytest

from fpirhc.summary import in_percent, written_out


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.0, "0 %"),
        (2.31e-37, "less than 0.001 %"),
        (1e-5, "0.001 %"),
        (0.0167, "1.67 %"),
        (0.986, "98.6 %"),
        (1.0, "100 %"),
    ],
)
def test_shares(share, text):
    """A share that is not zero is not told as zero, and not with a power of ten."""
    assert in_percent(share) == text


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (1600.0, 2, "1 600"),
        (245_120.0, 3, "245 000"),
        (12.34, 3, "12.3"),
        (0.0042, 2, "0.0042"),
        (-1600.0, 2, "-1 600"),
        (4.05e3, 3, "4 050"),
        (1.234e-5, 3, "1.23e-5"),
        (4.6e275, 2, "4.6e275"),
        (0.0, 3, "0"),
    ],
)
def test_numbers_as_people_write_them(value, digits, text):
    """Thousands stand apart; what is too large or too small to be written out has a power as people write it."""
    assert written_out(value, digits) == text
