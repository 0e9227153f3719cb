"""Controllers that break the contract, each in one thing, and the right one that they are made from."""

from dataclasses import dataclass, field, replace

import casadi as ca

import fpirhc as fp
from fpirhc.contracts import Block, Controller, Deformation, Layout, closing_blocks, like, reference_block
from fpirhc.errors import NotSupported


@dataclass(frozen=True)
class Gentle(Controller):
    """q''Des = q''N + rate^2 e + 2 rate e', saturated; a controller that keeps every law."""

    rate: float
    deformation: Deformation = field(default_factory=fp.Identity)
    limit: float = 40.0

    def blocks(self, built):
        plant, motion = built.plant, self.motion(built.plant)
        size = len(plant.chains)

        def step(s):
            error = s.reference - getattr(s, motion.name)
            wanted = self.rate**2 * error[:size] + 2 * self.rate * error[size:]
            nominal = s._reference_response
            return {"nominal": nominal, "desired": nominal + self.limit * ca.tanh(wanted / self.limit)}

        reads = Layout((motion, like(plant.output, "reference"), plant.response_signal("_reference_response")))
        writes = Layout((plant.response_signal("nominal"), plant.response_signal("desired")))
        closing, delays = closing_blocks(built, self.deformation)
        return [reference_block(built), Block("law", reads, writes, step), *closing], delays

    def check(self, problem):
        if problem.plant.step is not None or set(problem.plant.chains.values()) != {2}:
            raise NotSupported("Gentle feeds back an error and its derivative: outputs of relative order 2 only")

    def motion(self, plant):
        return plant.output

    def changed(self, built, name, change):
        """Return its blocks with the step of one of them wrapped: change(step, signals)."""
        blocks, delays = Gentle.blocks(self, built)
        return [
            replace(b, step=lambda s, b=b: change(b.step, s)) if name in (b.name, "every") else b for b in blocks
        ], delays


class KnowsThePlant(Gentle):
    """Inverts the plant and not the model."""

    def blocks(self, built):
        def exact(step, s):
            if hasattr(s, "parameters"):
                s.parameters = ca.DM(built.plant.exact)
            return step(s)

        return self.changed(built, "every", exact)


class LeavesTheLimits(Gentle):
    """Gives the command before it is limited."""

    def blocks(self, built):
        return self.changed(built, "limit", lambda step, s: {**step(s), "command": s.command_unclipped})


class SaysItLearns(Gentle):
    """Learns nothing."""

    @property
    def learns(self):
        return True


class SaysItDeformsNoResponse(Gentle):
    """Deforms the response all the same."""

    @property
    def deforms(self):
        return "command"


class DeformsAnotherResponse(Gentle):
    """Deforms another desired response than the one that it logs."""

    def blocks(self, built):
        def louder(step, s):
            s.desired = 1.05 * s.desired
            return step(s)

        return self.changed(built, "deform", louder)


class AlwaysOk(Gentle):
    """Hides a command that was held."""

    def blocks(self, built):
        return self.changed(built, "judge", lambda step, s: {"status": 0 * s._held})


class TakesTheStateForTheOutput(Gentle):
    """Feeds back the state, whatever the outputs are."""

    def motion(self, plant):
        return plant.state


class IgnoresItsDeformation(Gentle):
    """Builds itself without the deformation that it was given."""

    def blocks(self, built):
        return Gentle(self.rate).blocks(built)


class NamesAnotherLaw(Gentle):
    """Tells of a law ten times as fast."""

    @property
    def tracking(self):
        return fp.Exponential(rate=10 * self.rate, integral=False)


class SaysItControlsMaps(Gentle):
    """Refuses no map, and can control none."""

    def check(self, problem):
        """Wrong."""


class PushesAway(Gentle):
    """Answers an error with the wrong sign."""

    def blocks(self, built):
        def turned(step, s):
            said = step(s)
            return {**said, "desired": 2 * said["nominal"] - said["desired"]}

        return self.changed(built, "law", turned)


class NotesAreOneText(Gentle):
    """Its notes are a text, which a report would write letter by letter."""

    def notes(self, problem):
        del problem
        return "It feeds back a saturated error."
