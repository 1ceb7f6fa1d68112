"""Does the covariance tell the truth? Errors against the stated covariance: rmse, coverage, NEES, NLL, CRPS."""

from implicam.coverage.assessment import assess, tercile_labels
from implicam.coverage.intervals import Estimate
from implicam.coverage.model import LEVELS, NEES_RIGHT, Coverage, Level, Summary

__all__ = ["LEVELS", "NEES_RIGHT", "Coverage", "Estimate", "Level", "Summary", "assess", "tercile_labels"]
