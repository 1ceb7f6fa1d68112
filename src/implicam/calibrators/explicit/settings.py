"""Every prior and threshold of explicit; how to read a name: `implicam.settings`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

from implicam.rig_model import CameraSettings, RigModelSettings


@dataclass(frozen=True, kw_only=True, repr=False)
class ExplicitSettings(CameraSettings):
    """The settings of `Explicit(settings=...)`.

    >>> import implicam as ic
    >>> ic.Explicit(settings=ic.ExplicitSettings()).settings == ic.ExplicitSettings()
    True
    """

    # what the pixels of a camera are like
    stretched_log_aspect_prior_sd: float = 0.35
    """Prior sd of log(fy / fx) of pixels that need not be square: 0.5 and 2 are two of them away."""
    cropped_centre_prior_sd_sides: float = 0.4
    """Prior sd of the principal point of a cut-out picture, in the longer side."""
    stretched_odds_ratio: float = 20.0
    """How many times rarer than the usual are pixels that are not square, before a view is seen."""
    cropped_odds_ratio: float = 20.0
    """How many times rarer are cut-out pictures."""
    any_pixels_odds_ratio: float = 50.0
    """How many times rarer are pixels that are not square in a cut-out picture."""
    centre_prior_widening_ratio: float = 5.0
    """How many times wider the prior of the principal point is where known points give the lens: in forward-gp, a field
    can make up for it."""
    max_usual_gain_nats: float = 6.0
    """The widest prior loses less than so much log evidence to the usual one: then those between are looked at, too."""
    max_lacking_nats: float = 100.0
    """Log evidence that a kind of pixels may lack from one start and still be looked at from others."""

    # which lens model
    point_folds: int = 5
    """Parts of a camera's views of known points, each predicted from the others by every lens model."""
    board_folds: int = 3
    """Parts of a camera's boards, each predicted from the others by every lens model."""

    # noise
    noise_prior_median_half_sides: float = 3e-4
    """Prior median of the noise while pixels are compared: without it six views would be explained exactly."""
    noise_prior_log_sd: float = 2.0
    """Prior sd of its logarithm."""
    noise_prior_residuals: float = 2.0
    """So many residuals the stated noise counts like, or that of all cameras together where none is stated."""

    # pictures as in a mirror
    max_mirrored_ratio: float = 0.3
    """What is left mirrored, over what is left as it is: below, pictures or known points are mirrored."""
    min_mirrored_error_half_sides: float = 2e-3
    """Median error of a start from which the pictures may be mirrored."""

    # one camera from boards
    min_corners: int = 12
    """Corners of one picture; with fewer it says little more than that there is a board."""
    max_boards_for_lens: int = 30
    """Boards that the lens is looked for with; the adjustment has them all."""
    max_boards_for_pixels: int = 6
    """Boards that the shape of the pixels is first looked for with."""
    max_board_start_error_half_sides: float = 0.03
    """Usual error of the best lens for a camera's boards, beyond which it is none."""
    max_board_error_ratio: float = 4.0
    """Median error of a board, over the camera's usual residual, beyond which its pose is looked for again."""
    cauchy_scale_sds: float = 3.0
    """Residuals beyond which a corner counts less, by Cauchy's loss, until the adjustment has settled."""

    # all cameras from boards
    max_corner_error_sds: float = 5.0
    """Error beyond which a corner is wrong: one in 270,000 of good ones."""
    max_wrong_corner_share: float = 0.15
    """Share of the corners that do not fit, beyond which cameras contradict each other and nothing makes up for it."""
    max_camera_error_half_sides: float = 0.02
    """Usual residual of a camera in the whole rig beyond which there is no fit."""
    min_shared_boards: int = 3
    """Boards that two cameras must share before what they leave says anything of the rig."""
    max_together_ratio: float = 2.0
    """What two cameras leave together over what they leave alone, beyond which they contradict each other: lens models
    that do not hold their lenses make at most 1.25 of it where they leave as much as the noise, 1.7 where they leave
    three times as much (docs/decisions/0018)."""
    max_together_error_half_sides: float = 0.01
    """Usual residual of two such cameras together beyond which no error bar makes up for it."""
    max_moved_extents: float = 0.1
    """Part of the boards' extent that they may seem to have moved between pictures: more is no lag of a camera."""
    unnoticed_moves_extents: tuple[float, ...] = (3e-4, 1e-3)
    """Parts of the boards' extent that they may have moved without anybody having noticed."""
    min_moved_gain_nats: float = 10.0
    """Log evidence that moved boards must gain."""
    max_unknown_focal_share: float = 0.01
    """Part of the focal length that may be unknown without a note."""

    # a place in the world: cameras that boards join
    max_aligned_squared_mahalanobis: float = 25.0
    """Squared distance, in its own covariance, of a known point from where it should be: one in 65,000 of good ones."""
    error_ratio_prior_log_sd: float = 0.3
    """Prior sd of the logarithm of how many times larger errors are than the boards say: lenses that their models do
    not hold show in what is left at the known points (misfit.py)."""
    min_icp_residual_ratio: float = 1.3
    """Two ways to match points by closeness are told apart where one leaves so many times what the other leaves."""
    max_alignment_error_extents: float = 0.05
    """Part of the extent of the known points that the boards may be off without being of another rig."""

    # a place in the world: cameras that saw their boards alone
    min_width_ratio: float = 0.02
    """Extent of the known points across their longest line, over that: less is a line."""
    max_place_error_half_sides: float = 0.02
    """Median error of the best place beyond which it is none."""
    max_second_place_chi_squared: float = 9.0
    """Squared residuals, in the noise, that a second place may have more than the first and be as good."""

    # the paper's own pipeline with OpenCV: the presets paper and paper-bundle
    wide_from_degrees: float = 75.0
    """Horizontal angle of view from which a lens is wide: the paper's 2.8 mm lenses are regular, those up to 2.2 mm
    not."""
    min_own_pictures: int = 10
    """Pictures that a camera took alone, from which its lens is learned from those only, as in the paper."""
    min_pair_pictures: int = 3
    """Pictures that two cameras took together, for a stereo calibration."""
    fisheye_start_focal_ratio: tuple[float, ...] = (1.25, 1.5, 2.0, 3.0)
    """Focal lengths to start from where OpenCV's own guess leads nowhere, over that guess, the longer side / pi."""
    max_reprojection_half_sides: float = 0.02
    """Reprojection error of a camera beyond which OpenCV's answer is none."""
    max_picture_error_ratio: float = 5.0
    """Reprojection error of a picture over the camera's median one, beyond which the picture is taken out."""

    @cached_property
    def rig_model(self) -> RigModelSettings:
        """For the rig model, whose field and whose errors of known positions this method has no use for."""
        return RigModelSettings(**{field.name: getattr(self, field.name) for field in fields(CameraSettings)})


OF_PIPELINE = (
    "wide_from_degrees",
    "min_own_pictures",
    "min_pair_pictures",
    "fisheye_start_focal_ratio",
    "max_reprojection_half_sides",
    "max_picture_error_ratio",
)
"""That the preset `joint` has no use for."""

OF_PAPER_PRESETS = (
    *OF_PIPELINE,
    "min_corners",
    "min_icp_residual_ratio",
    "max_alignment_error_extents",
    "max_mirrored_ratio",
)
"""All that the paper's presets use."""

DEFAULT_SETTINGS = ExplicitSettings()
"""What `Explicit()` uses."""
