"""Modules that can be called: `ic.detect("my-photos", target="ball")`, and `ic.detect.Ball` as before.

A function of the package's own namespace cannot have the name of a module of it: importing the module would replace it.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any


class CallableModule(ModuleType):
    """A module that passes calls on to one of its functions."""

    def __call__(self, *args: Any, **options: Any) -> Any:
        """What the function returns."""
        return self.__dict__["__wrapped__"](*args, **options)


def make_callable(name: str, function: Callable[..., Any]) -> None:
    """Let a module be called as one of its functions; `help` and editors show the function's signature.

    Args:
        name: Of the module, its `__name__`.
        function: What a call does.
    """
    module = sys.modules[name]
    module.__class__ = CallableModule
    module.__dict__.update(__wrapped__=function, __signature__=inspect.signature(function))
