"""What answers a target: a simulated rig, a recorded dataset. A robot with cameras, and a person: session/."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from implicam.active.loop import Answer, Target
from implicam.dataset import Dataset
from implicam.simulate import Rig, simulate
from implicam.simulate import Target as Shown


@dataclass(eq=False)
class SimulatedOracle:
    """A simulated rig that looks at a ball where the target is.

    Attributes:
        rig: The rig.
        seed: Of the noise.
        robot_noise: Standard deviation of the known position per axis, in the length unit.
        missing: Probability that a view is lost.
        fails: Probability that nothing is measured at all.
        asked: How many targets it was asked for.
    """

    rig: Rig
    seed: int = 0
    robot_noise: float = 0.0
    missing: float = 0.0
    fails: float = 0.0
    asked: int = field(default=0, init=False)

    def observe(self, target: Target) -> Answer:
        """Measure one known point with the views of the cameras that see it.

        Args:
            target: Where the ball is put.

        Returns:
            The point; or the reason why nothing was measured: the ball was not found, or no camera sees the place.
        """
        self.asked += 1
        if np.random.default_rng([self.seed, self.asked, 7]).random() < self.fails:
            return Answer(None, "the ball was not found")
        names = np.array([target.name])
        data = simulate(
            self.rig, Shown("ball", names, names, target.xyz[None]), seed=1_000_003 * self.seed + self.asked,
            robot_noise=self.robot_noise, missing=self.missing,
        )  # fmt: skip
        return Answer(data) if data.observations.seen.any() else Answer(None, "no camera sees this place")


@dataclass(frozen=True, eq=False)
class RecordedOracle:
    """A dataset that was recorded before.

    A target is answered by the point nearest to it that was not used yet; of several at one place, by the one with the
    target's name.

    Attributes:
        data: The recorded points.
        used: The names of those that were used.
    """

    data: Dataset
    used: set[str] = field(default_factory=set)

    def observe(self, target: Target) -> Answer:
        """Answer with the nearest point that is left.

        Args:
            target: Where a point is wanted.

        Returns:
            The point; or the reason why there is none: all are used.
        """
        names = self.data.points.tolist()
        left = [i for i, name in enumerate(names) if name not in self.used]
        if not left:
            return Answer(None, "every recorded point is used")
        distance = np.linalg.norm(self.data.xyz[left] - target.xyz, axis=1)
        nearest = [left[k] for k in np.flatnonzero(distance == distance.min())]
        i = next((k for k in nearest if names[k] == target.name), nearest[0])
        self.used.add(names[i])
        return Answer(self.data.select([i]))
