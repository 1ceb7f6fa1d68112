"""Every prior and threshold of inverse-gp; how to read a name: `implicam.settings`.

Priors are in the standardised pixels of inverse_maps.py. How lengthscales are bounded is an option of the method,
`shortest_lengthscale`; what the search for them does is with `implicam.gp`.
"""

from __future__ import annotations

from dataclasses import dataclass

from implicam.calibrators.every_camera import EveryCameraSettings


@dataclass(frozen=True, kw_only=True, repr=False)
class InverseGPSettings(EveryCameraSettings):
    """The settings of `InverseGP(settings=...)`.

    >>> import implicam as ic
    >>> ic.InverseGP(settings=ic.InverseGPSettings()).settings == ic.InverseGPSettings()
    True
    """

    # priors of the smooth map
    axis_lengthscale_prior_median_sds: float = 6.0
    """Prior median of the lengthscales along principal components, in the standard deviation of one. A map that is
    linear up to a tenth over the image has about this one."""
    pixel_lengthscale_prior_median_sds: float = 12.0
    """Prior median of the lengthscales of pixel coordinates: it says the same of more coordinates."""
    common_lengthscale_prior_log_sd: float = 1.0
    """Prior sd of the log lengthscales, of all together."""
    own_lengthscale_prior_log_sd: float = 0.5
    """Prior sd of each log lengthscale beside the others."""
    max_points_for_both_bases: int = 100
    """Known points up to which lengthscales are tried along principal components and pixel by pixel: both cost little;
    beyond, principal components were always as good."""
    min_residuals: int = 8
    """Known points beside the functions of the mean, to learn the covariance from; else the mean gets fewer."""

    # pixels that are unlike those learned from
    max_distance_ratio: float = 8.0
    """So many times as far as the farthest known point is from the others, nothing learned says what is there. In 36
    simulated rigs no point within the volume of 17 to 157 known points was beyond 6.6."""
    max_plane_distance_ratio: float = 2.0
    """The same where known positions lie nearly in one plane: across it nothing is learned but noise."""
    min_points_for_curved_sheet: int = 8
    """Known points to spare before the sheet that the known pixels lie on may be curved."""

    # what a user should know
    max_thin_error_ratio: float = 0.25
    """Errors of known points across their plane, over their thickness, at which little is learned of that direction."""
    max_left_out_error_sds: float = 5.0
    """Leave-one-out error of a known point beyond which it is suspect: one in a million if all is well."""

    # the preset `paper`, which is GPyTorch's training
    paper_training_steps: int = 200
    """Steps of Adam: 200 come down to the paper's average standard deviations (paper_preset.py)."""
    paper_learning_rate: float = 0.1
    """Learning rate of Adam, of GPyTorch's own tutorial."""


OF_SMOOTH = (
    "axis_lengthscale_prior_median_sds",
    "pixel_lengthscale_prior_median_sds",
    "common_lengthscale_prior_log_sd",
    "own_lengthscale_prior_log_sd",
    "max_points_for_both_bases",
    "min_residuals",
    "max_distance_ratio",
    "max_plane_distance_ratio",
    "min_points_for_curved_sheet",
)
"""That the preset `smooth` alone uses."""

OF_PAPER_PRESET = ("paper_training_steps", "paper_learning_rate")
"""That the preset `paper` alone uses."""

DEFAULT_SETTINGS = InverseGPSettings()
"""What `InverseGP()` uses."""
