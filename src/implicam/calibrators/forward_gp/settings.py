"""Every prior and threshold of forward-gp: those of the rig model, and those of the method itself.

How to read a name: `implicam.settings`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from implicam.rig_model.settings import RigModelSettings
from implicam.rig_model.training_data import TrainingData

KINDS = ("ordinary", "aspect", "crop", "free")
"""Kinds of cameras, by name."""


class CameraKind(NamedTuple):
    """Prior sds: of p and q of the pixels' shape, of the tilt, of the principal point in the longer side of the image;
    prior odds of the kind."""

    p: float
    q: float
    tilt: float
    centre: float
    odds: float


@dataclass(frozen=True, kw_only=True, repr=False)
class ForwardGPSettings(RigModelSettings):
    """The settings of `ForwardGP(settings=...)`; names and units as in `RigModelSettings`.

    Pairs are of the image, in half its longer side, and of the log distance.

    >>> import implicam as ic
    >>> ic.ForwardGP(settings=ic.ForwardGPSettings(error_bar_level=0.9)).settings.error_bar_level
    0.9
    """

    # kinds of cameras, eqs. (3) and (K1): sds of p, q, tilt and centre, and odds, as of `CameraKind`
    ordinary_kind: tuple[float, float, float, float, float] = (0.001, 1e-5, 1e-5, 0.02, 1.0)
    """Square pixels, the lens over the image's centre."""
    aspect_kind: tuple[float, float, float, float, float] = (0.15, 0.02, 1e-5, 0.02, 0.05)
    """Pixels of any shape."""
    crop_kind: tuple[float, float, float, float, float] = (0.001, 1e-5, 1e-5, 0.4, 0.05)
    """The lens anywhere."""
    free_kind: tuple[float, float, float, float, float] = (0.15, 0.08, 0.3, 0.4, 0.02)
    """All of it, and a tilted image plane."""
    mirrored_odds: float = 0.2
    """Prior odds of a mirrored picture; each kind and sign gains 1 for every other camera of the rig that has it."""
    telephoto_edge_sd: tuple[float, float] = (0.01, 0.0005)
    """What k1 and k2 may do at the edge of the image at least, as a part of the radius: at 2 degrees a prior of the
    angle alone would allow no distortion at all."""
    rho_prior_sd_per_wf: float = 3.0
    """Prior sd of the inverse distance of the working frame's origin."""
    choice_signal_log_sd: float = 0.5
    """Sd of the log size of the field while kinds are compared: a field of 100 px must not stand in for a tilt."""
    choice_lengthscale: tuple[float, float] = (1.0, 2.0)
    """Lengthscales of the field meanwhile."""
    at_infinity_nats: float = 3.0
    """Nats against a camera at the largest distance there is: a perspective of the wrong sign ends there."""
    max_choice_views: int = 200
    """Views that kinds are compared by."""
    wandering_error_noises: float = 5.0
    """Median error of a free camera, in stated or usual noises, from which its field is so large that it would wander.
    Where it is small, a prior about the camera found would make error bars too small."""
    near_prior_sd: tuple[float, float, float, float] = (0.05, 0.05, 0.25, 0.25)
    """Of such a camera after the choice: sds of p, q, tilt and centre about the camera found."""
    near_rho_prior_relative_sd: float = 0.75
    """The same of the inverse distance, as a part of it."""

    # the quick path of an ordinary camera
    max_ordinary_error_half_sides: float = 2e-3
    """Median error of an ordinary camera; more needs a look at everything else."""
    max_freer_error_ratio: float = 0.6
    """A freer camera that brings the median error below this part asks for the whole choice."""
    min_freer_gain_nats: float = 3.0
    """So does one whose evidence, odds aside, is better by this less."""
    max_clear_error_noises: float = 2.0
    """Where the evidence of an ordinary camera is better by as much than that of a free one at the same place, its
    median error is below so many noises, and one step towards a free camera ..."""
    min_squares_left_share: float = 0.4
    """... leaves at least this part of the squares, no look from farther on is needed."""
    few_views: int = 18
    """Views fewer than which a camera of 17 numbers may go through most of them, whatever the others say."""

    # starts of all other cameras
    min_tolerated_noises: float = 10.0
    """Stated or usual noises that a view may be off and still start the fit, which judges it better."""
    max_kind_error_half_sides: float = 0.05
    """Median error beyond which a camera explains nothing."""
    max_kind_error_ratio: float = 10.0
    """A start whose errors are so many times the best camera's is no start for the kinds."""
    clearly_wrong_sign_ratio: float = 0.3
    """The sign whose best camera leaves the other's median times this is the right one without further question."""

    # sizes of field and noise, eq. (11) and the hierarchy after it
    lengthscale_prior_median: tuple[float, float] = (1.0, 2.0)
    """Prior medians of the lengthscales. Optics vary smoothly across the image; refraction and the entrance pupil vary
    with the distance as 1 / distance does."""
    lengthscale_prior_log_sd: tuple[float, float] = (0.7, 1.0)
    """Prior sds of their logarithms."""
    min_lengthscale: tuple[float, float] = (0.5, 0.1)
    """Lengthscales at least."""
    max_lengthscale: tuple[float, float] = (30.0, 100.0)
    """Lengthscales at most."""
    signal_prior_median_half_sides: float = 5e-4
    """Prior median of the field's sd: what good lens models leave, 0.3 px in 1280."""
    signal_prior_log_sd: float = 1.0
    """Prior sd of its logarithm."""
    signal_prior_median_half_sides_without_lens: float = 2e-2
    """Prior median of the field's sd beside a linear projection."""
    signal_prior_log_sd_without_lens: float = 2.0
    """Prior sd of its logarithm."""
    noise_prior_median_half_sides: float = 3e-4
    """Prior median of the noise: 0.2 px in 1280."""
    noise_prior_log_sd: float = 1.0
    """Prior sd of its logarithm."""
    stated_noise_log_sd: float = 0.2
    """Sd of the log noise about what the observations state, where they do."""
    camera_signal_log_sd: float = 0.3
    """Sd of the log size of one camera's field about the rig's."""
    camera_noise_log_sd: float = 0.15
    """Sd of the log noise of one camera about the rig's."""
    max_points_for_sizes: int = 300
    """Points of one camera that the sizes are found from; more cost time and tell little more."""
    max_uncertain_points_for_sizes: int = 50
    """The same where every point has an error of its own: three unknowns each."""

    # rounds of the fit
    max_rounds: int = 6
    """Rounds of sizes, posterior and wrong views."""
    max_rounds_with_shots: int = 18
    """The same where errors of shots are estimated, too."""
    min_search_rounds: int = 2
    """Rounds that look for lengthscales in any case, where known positions are exact."""
    max_changed_share: float = 0.01
    """The part of the views which, when they change later, tell nothing new of how smooth a field is."""
    shot_sd_tolerance: float = 0.1
    """Relative change of the shots' errors between two rounds below which they are found."""
    tail_rounds: int = 3
    """Rounds more where the noise has heavy tails."""
    max_median_error_noises: float = 4.0
    """Median error of a fitted camera at its own views, in its noise, beyond which the fit has failed."""
    max_points_for_position_errors: int = 400
    """Points that errors of known positions are estimated from; more cost time and tell little more."""
    max_tied_unknowns: int = 5000
    """Unknowns of all cameras that errors of known positions can tie together: a joint covariance of 0.2 GB, several of
    which are needed, and a minute for each step of the fit."""

    # a wand
    usual_wand_jitter_ratio: float = 1e-4
    """Sd of the length of a wand from frame to frame, over the length, where it is not stated: flex, and what is taken
    for the middle of a marker."""
    wand_camera_noise_log_sd: float = 0.3
    """Sd of the log noise of one camera about the rig's: what is left of its views by a wand says little of it, and
    nothing where each place is seen by two."""

    # cameras as linear projections with a large field
    min_views_without_lens: int = 40
    """Views that a camera without a lens model takes: its field must learn what a lens would say."""
    large_field_half_sides: float = 3e-3
    """A field's sd that makes an ordinary camera doubtful: 2 px in 1280."""
    min_gain_without_lens_nats: float = 3.0
    """By how much left-out views must at least be more probable without a lens model."""
    max_squared_error_medians: float = 20.0
    """Squared errors of known points, in their median, beyond which more does not count when fits are compared."""

    @property
    def kinds(self) -> dict[str, CameraKind]:
        """The kinds of cameras by name."""
        return {name: CameraKind(*getattr(self, f"{name}_kind")) for name in KINDS}

    def log_signal_prior(self, *, lens: bool) -> tuple[float, float]:
        """The prior of the log of the field's sd.

        Args:
            lens: The field is beside a lens model, and not beside a linear projection.

        Returns:
            Mean and sd, of a sd in half sides.
        """
        if lens:
            return math.log(self.signal_prior_median_half_sides), self.signal_prior_log_sd
        return math.log(self.signal_prior_median_half_sides_without_lens), self.signal_prior_log_sd_without_lens

    @property
    def log_noise_prior(self) -> tuple[float, float]:
        """Mean and sd of the log of the noise in half sides, where none is stated."""
        return math.log(self.noise_prior_median_half_sides), self.noise_prior_log_sd


DEFAULT_SETTINGS = ForwardGPSettings()
"""What `ForwardGP()` uses."""


@dataclass(frozen=True, eq=False)
class Training(TrainingData):
    """Known points, and what the method takes for usual."""

    settings: ForwardGPSettings
