"""What are the relative orders? They are the numbers of derivatives until an input appears, from the pattern of the symbols."""

from __future__ import annotations

from fpirhc.plant.lie_derivatives import structural_order
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.grid import ReviewGrid

QUESTION = "Are the relative orders those of the plant?"


def relative_orders(grid: ReviewGrid) -> Answer:
    """Return the structural order of every controlled coordinate; a sum below the size of the state leaves zero dynamics."""
    plant = grid.problem.plant
    declared = plant.response_orders
    structural = declared if plant.outputs else {c: structural_order(plant, c) for c in plant.controlled_names}
    text = ", ".join(f"{c} {r}" for c, r in structural.items())
    inside = plant.state.size - sum(declared.values())
    alone = "moves by itself" if inside == 1 else "move by themselves"
    whole = "; the controlled coordinates and their derivatives make up the whole state"
    text += f"; {inside} of {plant.state.size} states {alone}" if inside else whole
    numbers = {**{f"order_{c}": float(r or 0) for c, r in structural.items()}, "internal_states": float(inside)}
    if structural != declared:
        return Answer(
            QUESTION, Verdict.NO, text, "Write the response as the derivative that the input acts on.", numbers
        )
    return Answer(QUESTION, Verdict.YES, text, "", numbers)
