"""The maximum permissible error of a length, as specifications write it: `0.05`, `L/20000` or `0.05 + L/20000`."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from implicam.errors import UsageError

_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_GROWING = re.compile(rf"(?:(?P<constant>{_NUMBER})\+)?(?:(?P<factor>{_NUMBER})\*?)?L(?:/(?P<divisor>{_NUMBER}))?")


@dataclass(frozen=True)
class MaximumPermissibleError:
    """A limit of the error of a length that grows with the length.

    Attributes:
        constant: The part that every length has, in the length unit.
        per_length: The part that grows, over the length: 1/K of A + L/K.
    """

    constant: float
    per_length: float = 0.0

    def __post_init__(self) -> None:
        parts = (self.constant, self.per_length)
        if not all(math.isfinite(part) and part >= 0 for part in parts) or not sum(parts) > 0:
            raise UsageError(
                f"a maximum permissible error of {self.constant:g} + {self.per_length:g} L is no limit.",
                fix='give a number above 0, or one that grows with the length: "0.05 + L/20000"',
            )

    @classmethod
    def parse(cls, text: str | float) -> MaximumPermissibleError:
        """Read a limit.

        Args:
            text: A number, or text of the form `A + L/K`; A, K and L in the length unit of the calibration.

        Raises:
            UsageError: It is no limit.
        """
        if not isinstance(text, str):
            return cls(float(text))
        plain = re.sub(r"\s", "", text).replace("×", "*")
        if re.fullmatch(_NUMBER, plain):
            return cls(float(plain))
        found = _GROWING.fullmatch(plain)
        divisor = float(found["divisor"] or 1) if found else 0.0
        if found is None or divisor == 0:
            raise UsageError(
                f"the maximum permissible error {text!r} cannot be read.",
                why='it is a number, or grows with the length L: "A + L/K", all in the length unit of the calibration',
                fix='for example --mpe 0.05, or --mpe "0.05 + L/20000"',
            )
        return cls(float(found["constant"] or 0), float(found["factor"] or 1) / divisor)

    def at(self, length: float) -> float:
        """The limit of a length, in the length unit.

        Args:
            length: In the length unit.
        """
        return self.constant + self.per_length * length

    def __str__(self) -> str:
        parts = [f"{self.constant:.6g}"] if self.constant else []
        parts += [f"L/{1 / self.per_length:.6g}"] if self.per_length else []
        return " + ".join(parts)
