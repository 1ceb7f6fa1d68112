"""A rig as tables: what cameras see and where their lines of sight are, and measuring with it, compiled or by NumPy.

`spline_table` (what cameras see of a box), `sight_lines` (where a pixel looks), `library` and `kernel.c` (the compiled
half), `array_solver` (the same by NumPy), `rig_table` (both together: fast where the tables are accurate, exact
elsewhere), `live` (one shot after the other). docs/decisions/0026-compiled-map.md; docs/speed.md.
"""

from implicam.tabulated.live import Live
from implicam.tabulated.rig_table import RigTable, why_not_tabulated

__all__ = ["Live", "RigTable", "why_not_tabulated"]
