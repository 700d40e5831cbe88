"""What a check found, and the limits beyond which it would spoil a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Level = Literal["ok", "note", "fault"]


@dataclass(frozen=True)
class Finding:
    """One check. value in `unit`, sigma its standard deviation where it has one; text says it in words."""

    name: str
    level: Level
    text: str
    value: float | None = None
    unit: str = ""
    sigma: float | None = None

    def row(self) -> dict[str, object]:
        """For JSON."""
        return {
            "check": self.name, "level": self.level, "value": self.value, "unit": self.unit, "sigma": self.sigma,
            "text": self.text,
        }  # fmt: skip


def measured(
    name: str, value: float, sigma: float, limit: float, unit: str, good: str, bad: str, times: float = 4.0
) -> Finding:
    """A fault where a value is over its limit and over so many times its sigma; texts have {value} and {sigma}."""
    wrong = abs(value) > limit and abs(value) > times * sigma
    unsure = 3.0 * sigma > 2.0 * limit
    text = (bad if wrong else good).format(value=value, sigma=sigma)
    if not wrong and unsure:
        text = f"this motion does not tell it (within {sigma:.2g} {unit})"
    return Finding(name, "fault" if wrong else "ok", text, value, unit, sigma)
