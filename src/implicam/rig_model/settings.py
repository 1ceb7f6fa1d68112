"""Priors and thresholds of the rig model, with the numbers of docs/method.md as their defaults.

`CameraSettings` are those of every method that has cameras; `RigModelSettings` those of cameras with a field as well.
How a name is read, and what is no setting: `implicam.settings`.
"""

from __future__ import annotations

from dataclasses import dataclass

from implicam.lenses import DistortionSds, KannalaBrandt
from implicam.lenses.kannala_brandt import AT_EDGE_PRIOR_SD, PRIOR_SD
from implicam.settings import Settings


@dataclass(frozen=True, kw_only=True, repr=False)
class CameraSettings(Settings):
    """The settings of cameras, of views that contradict each other, and of the alarm."""

    # a camera's start, eq. (7)
    max_start_error_medians: float = 8.0
    """Times the median error: farther off, a view does not start the fit; the fit itself has the finer test."""
    max_start_error_half_extents: float = 0.05
    """Median error of a start, in half the extent of the pixels, beyond which it is none."""

    # priors of cameras, eqs. (3) and (4); those of single lens families are with the lenses
    distortion_prior_sd: tuple[float, float, float, float] = PRIOR_SD
    """Prior sd of k1 ... k4 of a Kannala-Brandt lens, about the line from an equidistant to a perspective one."""
    distortion_at_edge_prior_sd: tuple[float, float, float, float] = AT_EDGE_PRIOR_SD
    """Prior sd of what each term may do at the edge of the image, as a part of the radius: it tames fisheyes."""
    log_aspect_prior_sd: float = 0.002
    """Prior sd of log(fy / fx) of an ordinary camera: pixels are square."""
    centre_prior_sd_sides: float = 0.02
    """Prior sd of the principal point about the image's centre, in the longer side."""

    # views that contradict the others, eq. (18)
    max_squared_mahalanobis: float = 25.0
    """Squared distance, in its own covariance, of a view from what all others predict: one in 270,000 of good ones."""

    # wrong views of a point, eqs. (21) and (W1) to (W3)
    disagree_p_value: float = 1e-4
    """Below this p-value the views disagree, and those are looked for that the others would do better without."""
    agree_p_value: float = 1e-3
    """The p-value that the others must have among themselves then."""
    clearly_better_ratio: float = 100.0
    """How many times better they must agree than without any other choice of as many views."""
    min_p_value: float = 1e-10
    """Below this p-value there is no position, but a wrong match: a number would be worse than none."""
    max_suspects_of_two: int = 8
    """Views of a point, the farthest off, that are combined to pairs."""
    max_suspects_of_three: int = 4
    """Views that are combined to triples."""

    # the alarm of a measured table
    min_alarm_points: int = 10
    """Of fewer points that can be tested nothing is said."""
    max_contradicting_share: float = 0.3
    """Share of the points that contradict, beyond which it is no longer them."""
    usual_wrong_share: float = 0.2
    """Share of wrong views in a table whose detection is bad, and whose rig is as it was."""
    false_alarm_probability: float = 5e-4
    """Probability that a sign is there where nothing is wrong."""
    alarm_p_values: tuple[float, ...] = (0.05, 0.01, 0.001)
    """p-values below each of these are few."""
    tolerated_error_bar_ratio: float = 1.3
    """By how much error bars may be too small without an alarm."""
    max_independent_points: int = 50
    """Points of a table that count as independent at most: all share what is not known of the cameras."""

    def distortion_sds(self, family: str) -> DistortionSds | None:
        """What these settings say of the distortion of a family of lenses; None where its own numbers hold.

        Args:
            family: The name of the family.

        Returns:
            The sds of its parameters, and of what each term may do at the edge of the image; None for another family
            than Kannala-Brandt.
        """
        known = family == KannalaBrandt.family
        return (self.distortion_prior_sd, self.distortion_at_edge_prior_sd) if known else None


@dataclass(frozen=True, kw_only=True, repr=False)
class RigModelSettings(CameraSettings):
    """And of cameras with a field: the posterior, errors of known positions, heavy tails."""

    # cameras that are linear projections, eqs. (4) and (7)
    max_start_error_half_extents_without_lens: float = 0.3
    """Median error of the start of a linear projection, which leaves the lens to its field, beyond which it is none."""
    projection_prior_relative_sd: float = 0.3
    """Prior sd of the numbers of a linear projection about those of its start, as a part of them."""

    # the field, eq. (8)
    typical_log_distance_sd: float = 0.12
    """Sd of the log distance of the known points in an ordinary rig. Where the volume is thinner, depth counts in its
    own spread: what a window or water does varies over the volume, however far that is."""

    # views that contradict the others, eq. (18): what a point's own view tells
    max_left_out_variance_ratio: float = 3.0
    """Variance of a view predicted without its own point over that of the noise: beyond it the point says how a camera
    is, and not how it is off itself."""

    # shots that are off, eqs. (16), (17) and (22)
    min_points_per_shot: int = 6
    """A shot's position is judged by its own points: so many at least."""
    initial_shot_sd_wf: float = 2e-3
    """Sd of a shot's error to begin with."""
    shot_sd_prior_median_wf: float = 3e-3
    """Prior median of how far a shot is off: a thousandth of the volume's size."""
    shot_sd_prior_log_sd: float = 1.0
    """Prior sd of its logarithm."""
    max_plate_thickness_ratio: float = 0.01
    """Thickness over width up to which the points of a shot are a plate."""
    max_plate_one_minus_cosine: float = 1e-4
    """One less the cosine between two plates up to which they are parallel: 0.8 degrees."""
    label_reach_gaps: float = 0.25
    """How far the label of a shot holds around it, as a part of the distance to the next one."""
    max_tilt_radii: float = 2.0
    """Plate radii off its centre beyond which a tilt says no more: it is small, and not a matter of the whole world."""

    # planes too few to tell, eq. (28)
    max_world_half_lengths: float = 3.0
    """Half lengths of the traverse off its middle to which the parabola through the shots is followed."""
    max_world_variance_ratio: float = 100.0
    """Times the variance of a shot's error to which it is followed: beyond, it says nothing any more."""
    across_sd_ratio: float = 0.7
    """Across the traverse a shot is off by this part of what it is along it. Experience with half a dozen targets, as
    the next two."""
    tilt_sd_ratio: float = 0.33
    """A tilt moves the rim of a shot by this part of its shift."""
    level_sd_ratio: float = 0.3
    """A level of one target is off by this part of a shot's error: machined in one piece, not moved and stopped
    again."""
    min_levels: int = 2
    """Levels of a stepped target at least."""
    max_levels: int = 12
    """Levels at most; more are a lattice."""
    min_points_per_level: int = 6
    """Points that a level has on average; a plane takes three."""
    max_level_thickness_ratio: float = 1e-3
    """Thickness of a level, and a tenth of the gap to the next, as a part of the target's extent."""

    # single known positions that are off, eqs. (23) to (26)
    position_sd_prior_median_wf: float = 5e-4
    """Prior median of the sd of a known position: machined, printed or driven there."""
    position_sd_prior_log_sd: float = 1.5
    """Prior sd of its logarithm."""
    position_anisotropy_prior_sd: float = 0.7
    """Prior sd of how the log sds of the directions differ from each other."""
    position_noise_prior_log_sd: float = 0.7
    """Prior sd of the log of how much of the noise is left; the fit took the errors of positions for noise."""
    min_position_gain_nats: float = 3.0
    """Nats of evidence by which errors of known positions must explain the views better than noise alone: 20 to 1."""
    position_degrees_of_freedom: tuple[float, ...] = (8.0, 4.0, 3.0)
    """Degrees of freedom of a Student t that are tried beside the normal distribution: three is the fewest, in whole
    numbers, with a variance."""
    min_position_tail_gain_nats: float = 3.0
    """Nats by which a tail must do better than the normal distribution."""
    max_position_log_sd_variance: float = 1.0
    """At most this variance of a log sd enters a mean variance: its tail is not normal."""
    max_position_log_noise_variance: float = 0.25
    """The same of the log noise."""
    error_bar_level: float = 0.95
    """What error bars are judged by. The variance of a t would do for all levels together, and too little for this."""

    # pixel noise with heavy tails, eqs. (T1) to (T5)
    tail_degrees_of_freedom: tuple[float, ...] = (2.2, 2.6, 3.0, 3.5, 4.2, 5.0, 7.0, 10.0, 20.0)
    """Degrees of freedom tried. With two or fewer the noise has no variance, with more than 20 it is nearly normal."""
    min_tail_views: int = 60
    """Views from which tails can be told."""
    max_tail_views_per_camera: int = 1000
    """Views of a camera that the degrees are found from; more cost time and tell little more."""
    min_tail_gain_nats: float = 5.0
    """Nats by which a t must be more likely than normal noise: chance gains so much once in a thousand times."""
    max_wrong_detection_share: float = 0.3
    """Share of wrong detections, anywhere in the image, beyond which nothing is concluded."""
    min_confirming_tail_gain_nats: float = 2.0
    """The nats of what cameras say among themselves, which is less, and only has to confirm it."""
    max_confirming_points: int = 200
    """Points that this is taken from."""
    min_disagreement_variance_ratio: float = 0.5
    """Scale squared of what cameras disagree on, over that of what they miss the known positions by, below which the
    errors are those of the known positions."""
    max_views_with_second_mode: int = 4
    """Up to so many views, the posterior of a position may have a second mode, without one of them."""
    max_error_bar_ratio: float = 8.0
    """How many times larger an error bar may be than that of views that agree: beyond, there are two places, and
    nothing says which."""
    reweightings: int = 3
    """Times that the views of tied cameras are weighted to measure a point."""


DEFAULT_SETTINGS = RigModelSettings()
"""What a method uses whose settings cannot be chosen."""
