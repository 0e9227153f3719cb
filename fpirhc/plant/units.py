"""Units of quantities that follow from those of a plant."""


def derivative_unit(unit: str, derivative: int, time: str = "s") -> str:
    """Return the unit of a time derivative, with the unit of time: 'm' -> 'm/s' -> 'm/s^2'."""
    if derivative == 0:
        return unit
    return f"{unit}/{time}" if derivative == 1 else f"{unit}/{time}^{derivative}"


def with_space(unit: str) -> str:
    """Return a unit as it stands behind a number: ' kg', and nothing for '1'."""
    return "" if unit == "1" else f" {unit}"
