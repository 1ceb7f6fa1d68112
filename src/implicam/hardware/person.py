"""A person with a ruler, a height gauge or a slide: is asked to put the target somewhere, and says where it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar, Self

import numpy as np

from implicam.errors import HardwareError
from implicam.hardware.protocol import Floats, RobotOptions, check_position, incomplete_spec_error


class Person:
    """A person who moves the target, as a `Robot`. ask: called with each position (3,); sd: of what is typed, (3,)."""

    moves = alone = False
    spec: ClassVar[str] = "person"
    options: ClassVar[tuple[str, ...]] = ("sd",)

    @classmethod
    def from_spec(cls, rest: str, options: RobotOptions) -> Self:
        """A person as the robot.

        Args:
            rest: Must be empty.
            options: `ask` is required, `sd` is used where it is given.

        Raises:
            UsageError: Something follows the name, or there is no `ask`.
        """
        if rest or options.ask is None:
            raise incomplete_spec_error("robot", cls, rest)
        return cls(options.ask) if options.sd is None else cls(options.ask, options.sd)

    def __init__(self, ask: Callable[[Floats], None], sd: Sequence[float] = (np.nan, np.nan, np.nan)) -> None:
        self._ask = ask
        self.sd = (float(sd[0]), float(sd[1]), float(sd[2]))
        self._position: Floats | None = None

    def open(self) -> None:
        """Nothing to connect."""

    def set_position(self, xyz: Floats) -> None:
        """Say where the target is, as read from the ruler.

        Args:
            xyz: (3,) in the dataset's unit and world frame.

        Raises:
            HardwareError: These are not three finite numbers.
        """
        self._position = check_position(xyz)

    def position(self) -> Floats:
        """(3,) where the target was said to be last; HardwareError where nothing was said since the last move."""
        if self._position is None:
            raise HardwareError(
                "it is not known yet where the target is.",
                why="a person's position is known once it is typed",
                fix="put the target somewhere, measure x, y, z and type them",
            )
        return self._position.copy()

    def move(self, xyz: Floats) -> Floats:
        """Ask for the target to be put somewhere; where it ends up is what `set_position` is given afterwards.

        Args:
            xyz: (3,) the wish, in the dataset's unit and world frame.

        Returns:
            (3,) the wish.

        Raises:
            HardwareError: The wish is not three finite numbers.
        """
        wish = check_position(xyz)
        self._position = None  # unknown while the target is being moved
        self._ask(wish)
        return wish.copy()

    def stop(self) -> None:
        """Nothing to stop."""

    def reachable(self) -> Floats | None:
        """Anywhere."""
        return None

    def close(self) -> None:
        """Nothing to disconnect."""
