"""The guided session: each accepted point is on disk before the session says so."""

from implicam.session.database import DATABASE
from implicam.session.folder import UNDONE, is_session
from implicam.session.journal import Event, Session, Skipped

__all__ = ["DATABASE", "UNDONE", "Event", "Session", "Skipped", "is_session"]
