"""The paper's experiments. Each is a list of independent cells; `run` computes those that have no result yet.

>>> from implicam.experiments import Cell, run
>>> cells = [Cell("math:hypot", "taste/3-4", {})]  # a function of a module, a name, its options
>>> cells[0].options
{}
"""

from implicam.experiments.cells import Cell, Results, run

__all__ = ["Cell", "Results", "run"]
