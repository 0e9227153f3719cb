"""The law that each wrong member breaks, and a part of the sentence about it."""

from wrong import controllers, maps, observers, optimisers

CONTROLLERS = {
    controllers.KnowsThePlant: ("exact parameters are unknown", "in place of.*use plant.approximate"),
    controllers.LeavesTheLimits: ("command keeps the limits", "outside"),
    controllers.SaysItLearns: ("learning remembers", "learns is true, but after 400 cycles"),
    controllers.SaysItDeformsNoResponse: ("desired response is deformed", "deforms is 'command', but"),
    controllers.DeformsAnotherResponse: ("desired response is deformed", r"'deformed' misses .* by the share 0\.0[34]"),
    controllers.TellsAnotherModel: ("model is of the plant", r"the exact 'm' is 1\.1, the plant has 1:"),
    controllers.IsGivenTheExactParameters: ("exact parameters are unknown", "its command of cycle 0 is"),
    controllers.AlwaysOk: ("bad measurement never acts", "'a' measured as nan.*status of that cycle is OK"),
    controllers.TakesTheStateForTheOutput: ("outputs are controlled", "read plant.output and not plant.state"),
    controllers.IgnoresItsDeformation: ("deformation acts", "half of the effective gain 0.198"),
    controllers.NamesAnotherLaw: ("law is what it does", "fed back with 36, its law Exponential says 3600"),
    controllers.NotesAreOneText: ("notes are sentences", "its notes are 'It feeds"),
    controllers.SaysItControlsMaps: ("maps are controlled", "it says that it can control a map, but cannot be built"),
}
MAPS = {
    maps.HalfTheStep: ("step is bounded", r"above largest_step\(\) = 0.75"),
    maps.HalfTheSecant: ("secant is bounded", r"secant_gain\(\) 0.15 is below the effective gain 0.3"),
    maps.MovesItsFixedPoint: ("fixed point stays", "moved by 0.001"),
    maps.DividesByZero: ("fixed point stays", "moved by nan"),
    maps.OtherSign: ("first step is effective gain", "by the share 2"),
    maps.Kinked: ("first step is effective gain", "by the share 1"),
    maps.LouderFarOut: ("step is bounded", r"above largest_step\(\) = 1.5"),
    maps.Wavelet: ("only desired is fixed", "an error of 5.* a false fixed point is near"),
    maps.Fades: ("only desired is fixed", "a false fixed point is near"),
    maps.Rests: ("only desired is fixed", "an error of 1.* a false fixed point is near"),
    maps.GivesAnotherGain: ("gain can be set", "effective gain 1.6"),
    maps.SaysItIsLate: ("gain and pairs are told", "a response 3 cycles late a pair takes 4.01 times"),
    maps.SaysItIncrements: ("compares as it says", "with the increment, .* it requests 0.2942 and not 1"),
    maps.SaysItDoesNotAdapt: ("adaptation is told", "`adapts` is false, but.*0.3 per unit"),
    maps.FiltersTwice: ("gain and pairs are told", "a pair takes 2 times the gain off"),
}
OPTIMISERS = {
    optimisers.AlwaysOk: ("numbers are true far away", "calls a plan OK whose stationarity is"),
    optimisers.NoCost: ("plan is stationary", "reports the cost 0 of the plan, simulation gives"),
    optimisers.DoesNotShift: ("solution stays", r"shifted\(\) changes inputs of the plan by"),
    optimisers.LeavesTheBox: ("remembers a plan", "differs from the plan that it gave"),
    optimisers.ForgetsItsPlan: ("remembers a plan", "the next call would not begin with it"),
    optimisers.CountsThree: ("iterations are counted", "reports 3 iterations, but with iterations=3"),
    optimisers.TenthOfTheResidual: ("numbers are true far away", "reports the stationarity"),
    optimisers.SaysItMayTakeAnyTime: ("work is bounded as told", "calls no solver"),
}
OBSERVERS = {
    observers.EverySampleCounts: ("old samples do nothing", "with counts = 0.*by 0.4"),
    observers.EverySampleMoves: ("old samples do nothing", "with moves = 0"),
    observers.KnowsThePlant: ("exact parameters are unknown", "use evidence.parameters"),
    observers.ForgetsItsCorrection: ("wrong start is corrected", r"wrong by 0\.07 in the later|by 0\.07"),
}
CONTROLLER_MEMBERS = {  # member of the contract -> the law that tests it
    "blocks": "writes a command and a status",
    "check": "outputs are controlled",
    "deformation": "deformation acts",
    "deforms": "desired response is deformed",
    "inner": "facts hold",
    "inner_problem": "same command everywhere",
    "learns": "learning remembers",
    "notes": "notes are sentences",
    "plant_model": "model is of the plant",
    "planner": "facts hold",
    "with_defaults": "facts hold",
    "with_deformation": "deformation acts",
}
MAP_MEMBERS = {
    "adapts": "adaptation is told",
    "effective_gain": "first step is effective gain",
    "inner": "inner can be exchanged",
    "form": "compares as it says",
    "largest_step": "step is bounded",
    "memory": "graphs agree",
    "secant_gain": "secant is bounded",
    "shown": "shown is remembered",
    "step": "fixed point stays",
    "with_effective_gain": "gain can be set",
}
LOUD = "wrong start is corrected", "does not converge"  # a gain with which every correction is worse than the error
