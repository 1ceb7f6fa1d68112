"""Addresses without their secrets: for what is stored, logged, shown, or sent to somebody else."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable
from urllib.parse import quote, quote_plus, unquote

HIDDEN = "***"
"""Stands for a user name with its password, or another secret."""

_SCHEME = r"[A-Za-z][A-Za-z0-9+.-]{0,20}://"
_ADDRESS = re.compile(rf"({_SCHEME})([^\s\"'<>\\]*)")
_DRIVER = re.compile(r"^([A-Za-z]\w*:)([^/@:]+:[^@]*)@(?!.*\.cti$)")  # a driver's user:password@; serial numbers stay
_SECRET_VALUE = re.compile(
    r"((?:^|[?&;/_#,\s-])"
    r"(?:[\w.-]{0,40}(?:pass|pwd|psw|token|secret|auth|user|usr|login|account|credential|apikey|signature)[\w.-]{0,40}"
    r"|(?:[\w.-]{0,40}[._-])?(?:key|sig|sid|pin|pw))[=:])[^&;/#\s\"']+",
    re.IGNORECASE,
)  # some cameras want user=..._password=... in the path


def without_secrets(spec: str) -> str:
    """An address or another spec of equipment, with `HIDDEN` for user name and password and for values of keys that
    sound like secrets; all else stays as it is.

    Args:
        spec: As a command line names a camera, a robot or a trigger.

    >>> without_secrets("rtsp://admin:1234@192.168.0.21:554/main?channel=1&token=abc")
    'rtsp://***@192.168.0.21:554/main?channel=1&token=***'
    >>> without_secrets("genicam:22004351@/opt/maker/driver.cti")
    'genicam:22004351@/opt/maker/driver.cti'
    """

    def hide(text: str) -> str:
        return _SECRET_VALUE.sub(rf"\1{HIDDEN}", text)

    scheme = re.search(_SCHEME, spec)
    if scheme is None:
        return hide(_DRIVER.sub(rf"\1{HIDDEN}@", spec))
    before, rest = spec[: scheme.end()], spec[scheme.end() :]
    authority = re.split(r"[/?#]", rest, maxsplit=1)[0]
    if "@" in rest and ("@" in authority or not re.fullmatch(r"[^:]*(?::[0-9]*)?|\[.*", authority)):
        # the last @ ends it: passwords may have others, and slashes
        return f"{before}{HIDDEN}@{hide(rest[rest.rindex('@') + 1 :])}"
    return before + authority + hide(rest[len(authority) :])


def secrets_of(text: str, *, whole: bool = False) -> set[str]:
    """The passwords, user names and other secrets that stand in addresses, for a search for them elsewhere.

    Args:
        text: Any, such as lines of a log.
        whole: All of it is one address or spec: then a password may have blanks and quotes.

    >>> sorted(secrets_of("opened rtsp://admin:1234@h/x?token=abc twice"))
    ['1234', 'abc', 'admin']
    """
    found = set()
    for spec in [text] if whole else [one.group(0) for one in _ADDRESS.finditer(text)]:
        scheme = re.search(_SCHEME, spec)
        rest = spec[scheme.end() :] if scheme else spec
        if without_secrets(spec) != spec and "@" in rest:
            start = 0 if scheme else rest.index(":") + 1  # after a driver's name
            user, _, password = rest[start : rest.rindex("@")].partition(":")
            found |= {user, password}
        found |= {one.group(0)[len(one.group(1)) :] for one in _SECRET_VALUE.finditer(rest)}
    return {secret for secret in found if secret not in ("", HIDDEN)}


_LONG_CHARACTERS = 7
"""From which on a secret is looked for inside of words, too; a shorter one, such as 1234, stands alone."""


def replacing_secrets(known: Iterable[str]) -> Callable[[str], str]:
    """What puts `HIDDEN` for secrets wherever they stand in a text, however they are written there.

    Args:
        known: As `secrets_of` gives them.

    Returns:
        Text -> text.
    """
    patterns = []
    for secret in sorted({way for one in known for way in _ways_to_write(one)}, key=len, reverse=True):
        alone = len(secret) < _LONG_CHARACTERS or re.fullmatch(r"[0-9.,]+", secret)
        word = rf"(?:(?<![\w.])|(?<=%[0-9A-Fa-f]{{2}})){re.escape(secret)}(?![\w.])"
        patterns.append(word if alone else re.escape(secret))
    found = re.compile("|".join(patterns)) if patterns else None
    return lambda text: text if found is None else found.sub(HIDDEN, text)


def _ways_to_write(secret: str) -> set[str]:
    """As it is, in an address, in JSON, in Python."""
    plain = {secret, unquote(secret)}
    ways = {way for one in plain for way in (one, quote(one, safe=""), quote(one), quote_plus(one))}
    ways |= {text[1:-1] for one in plain for text in (json.dumps(one), json.dumps(one, ensure_ascii=False), repr(one))}
    return {way for way in ways if len(way) > 1}


def without_secrets_in(text: str) -> str:
    """A text whose addresses are as `without_secrets` leaves them.

    Args:
        text: Any, such as lines of a log.

    >>> without_secrets_in("camera left: rtsp://admin:1234@192.168.0.21/main cannot be opened.")
    'camera left: rtsp://***@192.168.0.21/main cannot be opened.'
    """
    return _ADDRESS.sub(lambda found: without_secrets(found.group(0)), text)


def only_hosts(text: str) -> str:
    """A text in which addresses are only scheme and host: what follows may be a secret, too, such as a stream's key.

    Args:
        text: Any, such as lines of a log.

    >>> only_hosts("camera left: rtsp://admin:1234@192.168.0.21:554/main cannot be opened.")
    'camera left: rtsp://192.168.0.21:554/*** cannot be opened.'
    """

    def bare(found: re.Match[str]) -> str:
        scheme, rest = found.groups()
        authority, more = re.match(r"([^/?#]*)(.*)", rest, re.DOTALL).groups()  # type: ignore[union-attr]
        host = authority.rpartition("@")[2]
        if "@" in more or not re.fullmatch(r"[\w.-]*(?::[0-9]{1,5})?[.,;:)]*|\[[0-9A-Fa-f:.]*\](?::[0-9]{1,5})?", host):
            return f"{scheme}{HIDDEN}"
        return f"{scheme}{host}" + (f"/{HIDDEN}" if more.strip("/.,;:)") else more)

    return _SECRET_VALUE.sub(rf"\1{HIDDEN}", _ADDRESS.sub(bare, text))
