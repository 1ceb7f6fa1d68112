"""forward-gp from a wand: two markers a known distance apart, waved at places that nobody knows, docs/wand.md.

In the order of the fit: `waves` (what was seen), `pairs` and `start` (from no guess), `bundle` (the adjustment),
`sizes` (of the fields and the noise), `fit`, `gauge` (where the world is), `fitted` (what a calibration keeps).
"""

from implicam.calibrators.forward_gp.wand.fitted import WandDiagnosis, Waved, fit_to_wand

__all__ = ["WandDiagnosis", "Waved", "fit_to_wand"]
