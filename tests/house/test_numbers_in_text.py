"""Numbers in sentences are written as people write them."""

from __future__ import annotations

import re

import numpy as np
import pytest

from fpirhc.review.question import Answer, Verdict
from fpirhc.studies.comparison.changes import Finding, Outcome
from fpirhc.studies.comparison.optimality import gap
from fpirhc.studies.comparison.pairwise import NullTest
from fpirhc.summary import in_percent, numbers_written_out, written_out


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


@pytest.mark.parametrize(
    ("excess", "text"), [(-0.6, "other optimum"), (-3e-9, "0"), (0.0, "0"), (0.0123, "0.012"), (2e-7, "2e-7")]
)
def test_a_plan_is_not_better_than_the_optimum(excess, text):
    """A negative gap is another optimum, or the accuracy of the solves."""
    assert gap(excess, 2) == text


@pytest.mark.parametrize(
    ("sentence", "text"),
    [
        ("the rms error of p is 1.69e+04 mmHg", "the rms error of p is 16 900 mmHg"),
        ("Use gain = -1.23e+05.", "Use gain = -123000."),
        ("Use Affine(gain=-1.2e-05).", "Use Affine(gain=-1.2e-5)."),
        ("from 1.2e-09 to 3e+05, 4.6e+275 times", "from 1.2e-9 to 300 000, 4.6e275 times"),
        ("0.2 with it, +2.4e-05 % of its range", "0.2 with it, +2.4e-5 % of its range"),
        ("see model_v1.2e+04 and 0x1e+05", "see model_v1.2e+04 and 0x1e+05"),
    ],
)
def test_sentences_have_numbers_as_people_write_them(sentence, text):
    """What a reader may copy into a file, after '=', stays a number of Python; names stay what they are."""
    assert numbers_written_out(sentence) == text


def test_no_sentence_of_verdict_or_review_has_a_padded_power():
    """For numbers of 40 decades in every usual format: no e+NN, no e-0N, and the value is that of the format."""
    random = np.random.default_rng(0)
    for _ in range(2000):
        value = float(random.choice([-1, 1]) * 10 ** random.uniform(-20, 20))
        for spec in (".2g", ".3g", ".4g", ".6g", "g", ".3e"):
            before = f"It is {value:{spec}} N, gain = {value:{spec}}."
            said = Answer("q", Verdict.NO, before, before)
            null = NullTest(("a", "b"), {}, {}, Outcome.WORSE, True, before, 1)
            for text in (said.evidence, said.change, Finding(before).text, null.text):
                assert not re.search(r"e\+|e-0", text)
                read, pasted = text.removeprefix("It is ").removesuffix(".").split(" N, gain = ")
                assert float(pasted) == float(read.replace(" ", "")) == float(f"{value:{spec}}")
