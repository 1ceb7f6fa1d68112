"""Where the world of a calibration without known positions is: from what its cameras measure, and without a new fit.

A wand says how the cameras stand to each other, and not where the floor is. Known points (the markers of an L-frame,
dots of a plate), points that an axis or a plane goes through, a plumb line, or a camera say it. What their measuring
leaves uncertain goes into the error bars of all positions; distances and their error bars stay what they are.

`points` (what may say it), `known_points`, `axes`, `call`; `judged` lays a world that nobody has set over known points.
"""

from implicam.world.call import set_world
from implicam.world.judged import in_another_frame, lay_over
from implicam.world.points import with_known_positions

__all__ = ["in_another_frame", "lay_over", "set_world", "with_known_positions"]
