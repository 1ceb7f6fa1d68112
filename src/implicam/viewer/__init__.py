"""The page of `implicam acquire`: what the cameras see, where the ball goes next, and when to stop."""

from implicam.viewer.bench_page import serve

__all__ = ["serve"]
