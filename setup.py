"""The compiled kernel of implicam.tabulated, which an installation may do without: docs/decisions/0026."""

from __future__ import annotations

import os

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

FOLDER = "src/implicam/tabulated"


class BuildKernel(build_ext):
    """It is loaded by ctypes: one file serves every version of Python, under a name that none takes for a module."""

    def get_ext_filename(self, fullname: str) -> str:
        """Where it goes, beside the module that loads it."""
        return os.path.join(*fullname.split(".")[:-1], "kernel.native")

    def build_extension(self, ext: Extension) -> None:
        """Compile it, optimised as its benchmarks are."""
        if self.compiler.compiler_type == "msvc":
            ext.extra_compile_args = ["/O2"]
        else:
            ext.extra_compile_args = ["-O3", "-g0", "-fno-math-errno", "-fno-trapping-math", "-fvisibility=hidden"]
            ext.libraries = ["m"]
        super().build_extension(ext)


class KernelWheel(bdist_wheel):
    """One wheel for a platform, whatever its Python."""

    def get_tag(self) -> tuple[str, str, str]:
        """Of the file name."""
        return "py3", "none", super().get_tag()[2]


setup(
    ext_modules=[
        Extension(
            "implicam.tabulated._kernel",
            sources=[f"{FOLDER}/kernel.c"],
            depends=[f"{FOLDER}/kernel_body.h"],
            optional=True,  # without a compiler, NumPy does it
        )
    ],
    cmdclass={"build_ext": BuildKernel, "bdist_wheel": KernelWheel},
)
