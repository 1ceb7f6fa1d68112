"""forward-gp from a wand: two markers a known distance apart, waved at places that nobody knows, docs/wand.md.

In the order of the fit: `waves` (what was seen), `pairs` and `start` (from no guess), `bundle` (the adjustment),
`sizes` (of the fields and the noise), `fit`, `gauge` (where the world is), `fitted` (what a calibration keeps),
`held_out` (what speaks against it).
"""

from implicam.calibrators.forward_gp.wand.fitted import WandDiagnosis, Waved, fit_to_bars, fit_to_wand
from implicam.calibrators.forward_gp.wand.held_out import find_faults

__all__ = ["WandDiagnosis", "Waved", "find_faults", "fit_to_bars", "fit_to_wand"]
