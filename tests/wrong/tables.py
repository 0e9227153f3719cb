"""The law that each wrong member breaks, and a part of the sentence about it."""

from wrong import controllers, maps, observers, optimisers

CONTROLLERS = {
    controllers.KnowsThePlant: ("exact parameters are unknown", "in place of.*use plant.approximate"),
    controllers.LeavesTheLimits: ("command keeps the limits", "outside"),
    controllers.SaysItLearns: ("learning remembers", "learns is true, but after 400 cycles"),
    controllers.SaysItDeformsNoResponse: ("deformation acts", "deforms is 'command', but"),
    controllers.DeformsAnotherResponse: ("deformation acts", r"'deformed' misses .* by the share 0\.00[34]"),
    controllers.AlwaysOk: ("bad measurement never acts", "'a' measured as nan.*status of that cycle is OK"),
    controllers.TakesTheStateForTheOutput: ("what it takes it controls", "read plant.output and not plant.state"),
    controllers.IgnoresItsDeformation: ("deformation acts", "half of the effective gain 0.198"),
    controllers.NamesAnotherLaw: ("law is what it does", "fed back with 36, its law Exponential says 3600"),
    controllers.PushesAway: ("exact model tracks", "with the exact model"),
    controllers.NotesAreOneText: ("facts hold", "its notes are 'It feeds"),
    controllers.SaysItControlsMaps: ("what it takes it controls", "can control a map, but cannot be built"),
}
MAPS = {
    maps.HalfTheSecant: ("step is bounded", r"secant_gain\(\) 0.15 is below the effective gain 0.3"),
    maps.MovesItsFixedPoint: ("step is bounded", "an error of 0 moves the request by 0.00141"),
    maps.DividesByZero: ("derivatives are finite", "the value is not finite"),
    maps.OtherSign: ("gain can be set", "a OtherSign with the effective gain -0.8"),
    maps.Kinked: ("step is bounded", r"above \|secant_gain\(\)\| times it"),
    maps.Wavelet: ("only desired is fixed", "an error of 5.* a false fixed point is near"),
    maps.Rests: ("only desired is fixed", "an error of 1.* a false fixed point is near"),
    maps.GivesAnotherGain: ("gain can be set", "the effective gain 1.6"),
    maps.HidesNaN: ("nan shows", "a response of NaN is hidden"),
    maps.TellsTwiceItsGain: ("gain and pairs are told", "a pair takes 0.5 times the gain off"),
    maps.SaysItIsLate: ("gain and pairs are told", "a response 3 cycles late a pair takes 4.01 times"),
    maps.SaysItIncrements: ("compares as it says", "with the increment, .* it requests 0.2887 and not 1"),
}
OPTIMISERS = {
    optimisers.AlwaysOk: ("numbers are true", "calls a plan OK whose stationarity by"),
    optimisers.NoCost: ("numbers are true", "reports the cost 0 of the plan, simulation gives"),
    optimisers.DoesNotShift: ("solution stays", r"shifted\(\) changes inputs of the plan by"),
    optimisers.LeavesTheBox: ("remembers a plan", "differs from the plan that it gave"),
    optimisers.ForgetsItsPlan: ("remembers a plan", "the next call would not begin with it"),
    optimisers.CountsThree: ("iterations are counted", "reports 3 iterations, but with iterations=3"),
    optimisers.TenthOfTheResidual: ("numbers are true", "reports the stationarity"),
    optimisers.SaysItMayTakeAnyTime: ("work is bounded as told", "calls no solver"),
}
OBSERVERS = {
    observers.EverySampleCounts: ("old samples do nothing", "with counts = 0.*by 0.4"),
    observers.EverySampleMoves: ("old samples do nothing", "with moves = 0"),
    observers.KnowsThePlant: ("exact parameters are unknown", "use evidence.parameters"),
    observers.ForgetsItsCorrection: ("wrong start is corrected", r"wrong by 0\.07 in the later|by 0\.07"),
}
LOUD = "wrong start is corrected", "does not converge"  # a gain with which every correction is worse than the error
CONTROLLER_MEMBERS = {  # member of the contract -> the law that tests it
    "blocks": "same command everywhere",
    "check": "what it takes it controls",
    "deformation": "deformation acts",
    "deforms": "deformation acts",
    "exact_model": "exact parameters are unknown",
    "inner": "frozen value",
    "inner_problem": "same command everywhere",
    "learns": "learning remembers",
    "notes": "facts hold",
    "planner": "facts hold",
    "with_deformation": "deformation acts",
}
MAP_MEMBERS = {
    "adapts": "gain and pairs are told",
    "effective_gain": "gain and pairs are told",
    "inner": "frozen value",
    "form": "compares as it says",
    "memory": "gain and pairs are told",
    "secant_gain": "step is bounded",
    "step": "step is bounded",
    "with_effective_gain": "gain can be set",
}
TRACKING_MEMBERS = {
    "check": "error decays",
    "delays": "clipping freezes",
    "gains": "gains are what it does",
    "law": "zero error asks for the nominal response",
    "update": "clipping freezes",
}
OBSERVER_MEMBERS = {
    "check": "wrong start is corrected",
    "correct": "wrong start is corrected",
    "memory": "old samples do nothing",
    "predict": "right model believes what is",
    "uses": "wrong start is corrected",
}
