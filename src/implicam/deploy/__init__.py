"""Calibrations for programs without Python: ONNX graphs (`onnx_file`), and a table with a C++ header (`cpp_table`)."""

from implicam.deploy.cpp_table import write_cpp
from implicam.deploy.onnx_file import write_onnx

__all__ = ["write_cpp", "write_onnx"]
