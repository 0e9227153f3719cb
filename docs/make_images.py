"""Draws the README's picture: python docs/make_images.py"""

from pathlib import Path

import fpirhc as fp
from fpirhc.report.figures import headline_figure, save_figure

IMAGES = Path(__file__).resolve().parent / "images"


def main() -> None:
    """Compare RHC with RHC+FPI on two_mass and save positions and errors as a pair."""
    IMAGES.mkdir(exist_ok=True)
    comparison = fp.compare(fp.load_problem("two_mass"), seed=0, controllers=["RHC", "RHC+FPI"])
    figure = headline_figure(comparison, comparison["RHC"], comparison["RHC+FPI"])
    save_figure(figure, IMAGES / "two_mass.png")


if __name__ == "__main__":
    main()
