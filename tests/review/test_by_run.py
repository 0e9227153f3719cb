"""Where no linear loop and no prediction answers, two runs do: a law over what they show, and over who asks."""

from __future__ import annotations

from typing import Any, cast

import pytest

from fpirhc.review.prediction import TRIED
from fpirhc.review.question import Case, by_run
from fpirhc.simulation.trials import ErrorPair


class Told:
    """What `by_run` asks of a case, with errors of 1 m without adaptation on a range of 10 m."""

    def __init__(self, error: float, *, learns: bool, whole: bool, at_limit: float = 0.0, without: float = 1.0) -> None:
        self.problem = self.controller = self
        self.deformation, self.learns, self.diverges = None, learns, False
        self.cycles = TRIED if whole else TRIED + 1
        self._pair = ErrorPair({"q": without}, {"q": error}, {"q": 10.0}, {"q": "m"}, at_limit)

    def trial(self, _: object) -> tuple[ErrorPair, ErrorPair]:
        return self._pair, self._pair


def answer(error: float, **settings: Any) -> Any:
    return by_run(
        cast(Case, Told(error, **({"learns": False, "whole": False} | settings))), "Is it so?", "nothing else says"
    )


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize("whole", [False, True])
def test_a_smaller_error_is_a_yes_and_a_clearly_larger_one_a_no_unless_it_may_still_learn(learns, whole):
    """Twice the error and a hundredth of the range is clearly larger; in between nobody says."""
    told = {error: str(answer(error, learns=learns, whole=whole).verdict) for error in (0.9, 1.1, 3.0, float("inf"))}
    lost = "unknown" if learns and not whole else "no"
    assert told == {0.9: "yes", 1.1: "caution" if whole else "unknown", 3.0: lost, float("inf"): lost}


def test_advice_fits_the_run():
    """Nobody runs a whole task for longer; where commands stand at a limit no adaptation can act."""
    assert answer(1.1).change == "Run it for longer and compare."
    assert "longer" not in answer(1.1, whole=True).change
    assert "whole run" in answer(1.1, whole=True).evidence
    stuck = answer(0.9, at_limit=0.9)
    assert stuck.verdict == "unknown"
    assert "not informative" in stuck.evidence


@pytest.mark.parametrize("without", [1.0, float("inf")])
def test_a_run_that_ends_early_is_not_to_be_longer(without):
    """Where both end there is no smaller error either; what learns may still learn, but not in a run that has ended."""
    one = answer(float("inf"), without=without, learns=True)
    assert one.verdict == "unknown"
    assert one.change == "Find out why the run ends early."
