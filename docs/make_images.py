"""Draws the README's picture, and the price of a certificate from the table of its page: python docs/make_images.py"""

import re
from pathlib import Path

import matplotlib.pyplot as plt

import fpirhc as fp
from fpirhc.report.figures import headline_figure, save_figure

DOCS = Path(__file__).resolve().parent
IMAGES = DOCS / "images"
ROW = re.compile(
    r"^\| (\w+) \| ([\d.]+) % \| ([\d.]+) ms \| [\d.]+ \| \S+ ([\d.]+) % \| ([\d.]+) \| ([\d.]+) \|$", re.MULTILINE
)


def main() -> None:
    """Compare RHC with RHC+FPI on two_mass and save positions and errors as a pair."""
    IMAGES.mkdir(exist_ok=True)
    comparison = fp.compare(fp.load_problem("two_mass"), seed=0, controllers=["RHC", "RHC+FPI"])
    figure = headline_figure(comparison, comparison["RHC"], comparison["RHC+FPI"])
    save_figure(figure, IMAGES / "two_mass.png")
    draw_price()


def draw_price() -> None:
    """Draw tube and price of the certified plants over the period; a bound of first order is a line through zero."""
    rows = [
        (plant, *map(float, numbers)) for plant, *numbers in ROW.findall((DOCS / "certificate.md").read_text("utf-8"))
    ]
    figure, (tube, price) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
    for plant, mismatch in dict.fromkeys((row[0], row[1]) for row in rows):
        periods, widths, verified, certified = zip(*(row[2:] for row in rows if row[0] == plant), strict=True)
        name = f"{plant}, {mismatch:g} % mismatch"
        tube.plot(periods, widths, "o-", label=name)
        price.plot(periods, [100 * (c - v) for c, v in zip(certified, verified, strict=True)], "o-", label=name)
    tube.set(title="widest certified tube", ylabel="share of half the range (%)")
    price.set(title="cost above that of verified margins", ylabel="share of the cost without margins (%)")
    for axes in (tube, price):
        axes.set(xlabel="period (ms)", xlim=(0, None), ylim=(0, None))
        axes.grid(alpha=0.3)
    figure.legend(*price.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.savefig(IMAGES / "certificate_price.png", dpi=110)


if __name__ == "__main__":
    main()
