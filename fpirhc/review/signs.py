"""Do the eigenvalues of the response Jacobian have one sign? Only then does some gain converge."""

from __future__ import annotations

from fpirhc.contraction.spectrum import Spectrum
from fpirhc.review.answer import Answer, Verdict

QUESTION = "Do the eigenvalues of the response Jacobian have one sign?"


def one_sign(own: Spectrum, boxed: Spectrum) -> Answer:
    """Return the real parts along the reference, with the exact parameters and over the box."""
    text = f"real parts {own.smallest_real:.3g} to {own.largest_real:.3g}"
    text += f", over the box {boxed.smallest_real:.3g} to {boxed.largest_real:.3g}"
    numbers = {"smallest": own.smallest_real, "largest": own.largest_real}
    numbers |= {"smallest_over_box": boxed.smallest_real, "largest_over_box": boxed.largest_real}
    change = "Give the approximate parameters the sign of every input's effect, and let each input act on its own coordinate."
    if not own.one_sign:
        return Answer(QUESTION, Verdict.NO, text, change, numbers)
    verdict = Verdict.YES if boxed.one_sign else Verdict.UNKNOWN
    return Answer(QUESTION, verdict, text, "" if boxed.one_sign else change, numbers)
