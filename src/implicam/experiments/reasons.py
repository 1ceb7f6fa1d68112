"""Why findings of the paper do not hold on simulated rigs, where the reason is known."""

from __future__ import annotations

from implicam.experiments.plan import EXPLICIT, GP

STRONGER = (
    f"`{EXPLICIT}` here is stronger than the paper's: it adjusts all cameras, lenses and boards of all pictures "
    "together, and ten pictures of a camera are then enough. The paper calibrates each camera from its own pictures, "
    "and each pair after that. So this is no evidence against what the paper saw with its own."
)
WHY = {
    "gp_beats_explicit": STRONGER,
    "few_boards_hurt_explicit": STRONGER,
    "budget_matters_with_six_cameras": STRONGER,
    "learners_beat_poor_explicit": STRONGER,
    "sd_drops_fast": (
        f"That of the paper's software soon reaches its floor. That of `{GP}` goes on falling with its error, so less "
        "of the fall comes early."
    ),
    "any_start_converges": (
        f"The hyperparameters of `{GP}` are learned anew with every point, and its noise is not held at a floor: fits "
        "of different starts go on differing by what they have learned."
    ),
    "more_cameras_lower_sd": "With few points more cameras mean more lengthscales to learn from them.",
    "more_cameras_lower_rmse": (
        "In the paper's own table it does not hold with 3 boards either. With few planes the error is that of guessing "
        "between them, and more pixels do not help to guess."
    ),
    "gp_beats_network": "Where both can only guess, the smoother guess is not always the better one.",
    "last_boards_gain_least": "More boards help until the noise of the pictures is all that is left.",
    "fewest_points_too_few": "They are few; twice as many are few as well.",
    "nearer_is_less_accurate": (
        "Two effects go against each other. Near the cameras a step of the board moves the picture more, so the known "
        "pixels are sparser: that is the paper's. But a pixel stands for less depth there, so noise does less harm. "
        "The table of near and far below shows both."
    ),
}
"""Finding -> reason."""
