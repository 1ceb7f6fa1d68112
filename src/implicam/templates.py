"""Pages and accounts: text with gaps in a file beside the code that fills them (Jinja2)."""

from __future__ import annotations

from typing import Any

from implicam.errors import import_extra

SHARED_PACKAGE = "implicam.report"
"""Whose templates the pages of others import, as `report/NAME`."""


class Markup(str):
    """Text that is HTML already, by the convention of Jinja2: a template does not escape it."""

    __slots__ = ()

    def __html__(self) -> str:
        return self


def render(package: str, name: str, **values: Any) -> str:
    """Fill a template.

    Args:
        package: The package whose folder `templates` has the file.
        name: Of the file. In an .html file every value is escaped, so that a name with tags in it stays text.
        values: What the template calls by these names; one that is missing is an error, not an empty place.

    Returns:
        The text.

    Raises:
        MissingExtraError: Jinja2 is not installed.
    """
    jinja2 = import_extra("jinja2", "report", "a report")
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(
            [jinja2.PackageLoader(package), jinja2.PrefixLoader({"report": jinja2.PackageLoader(SHARED_PACKAGE)})]
        ),
        autoescape=name.endswith(".html"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    text: str = environment.get_template(name).render(values)
    return text
