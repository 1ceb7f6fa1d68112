"""Build an ONNX graph by writing arithmetic: float64 throughout, with operators that ONNX Runtime has for float64.

A `Value` is a table of numbers, mostly (n, columns), n being the points of a run. It has the operators of NumPy, with
NumPy's broadcasting, and NaN goes through them as there.

ONNX Runtime has no float64 Atan, Asin or Tan: `angle` takes the float32 one and mends it to the last bits by one step
with sine and cosine.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from implicam.dataset import Floats
from implicam.errors import import_extra

OPSET, IR_VERSION = 17, 8
"""Of ONNX 1.12 (2022), so that runtimes of the last years read it."""

Number = ArrayLike


class Graph:
    """A graph that grows as `Value`s are computed."""

    def __init__(self) -> None:
        self.onnx: Any = import_extra("onnx", "onnx", "the export to ONNX")
        self.nodes: list[Any] = []
        self.inputs: list[Any] = []
        self.outputs: list[Any] = []
        self._constants: dict[tuple[str, tuple[int, ...], bytes], str] = {}
        self._initializers: list[Any] = []

    def input(self, name: str, columns: int) -> Value:
        """A table that is given when the graph is run.

        Args:
            name: Of the input.
            columns: It is (n, columns).
        """
        self.inputs.append(self._info(name, ["n", columns]))
        return Value(self, name)

    def output(self, name: str, value: Value, *shape: int) -> None:
        """A table that the graph gives.

        Args:
            name: Of the output.
            value: (n, product of the shape).
            *shape: It is given as (n, *shape).
        """
        if len(shape) > 1:
            value = value.node("Reshape", self.integers([-1, *shape]))
        self.nodes.append(self.onnx.helper.make_node("Identity", [value.name], [name]))
        self.outputs.append(self._info(name, ["n", *shape]))

    def constant(self, numbers: Number) -> Value:
        """Numbers that belong to the graph.

        Args:
            numbers: Of any shape; float64 in the graph.
        """
        return self._constant(np.asarray(numbers, dtype=np.float64))

    def integers(self, numbers: Number) -> Value:
        """Integers that belong to the graph: shapes and indices.

        Args:
            numbers: Of any shape.
        """
        return self._constant(np.asarray(numbers, dtype=np.int64))

    def _constant(self, array: NDArray[Any]) -> Value:
        key = array.dtype.str, array.shape, array.tobytes()
        if key not in self._constants:
            self._constants[key] = f"c{len(self._constants)}"
            tensor = self.onnx.numpy_helper.from_array(np.ascontiguousarray(array), self._constants[key])
            self._initializers.append(tensor)
        return Value(self, self._constants[key])

    def _info(self, name: str, shape: list[str | int]) -> Any:
        return self.onnx.helper.make_tensor_value_info(name, self.onnx.TensorProto.DOUBLE, shape)

    def model(self, name: str, metadata: dict[str, str], description: str) -> bytes:
        """The whole as the bytes of an ONNX file.

        Args:
            name: Of the graph.
            metadata: Key -> text.
            description: For who opens the file.

        Returns:
            The same bytes for the same graph.
        """
        helper = self.onnx.helper
        graph = helper.make_graph(self.nodes, name, self.inputs, self.outputs, self._initializers)
        model = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="implicam"
        )
        model.doc_string = description
        helper.set_model_props(model, metadata)
        self.onnx.checker.check_model(model)
        return bytes(model.SerializeToString(deterministic=True))


class Value:
    """A result in a graph."""

    __array_priority__ = 100  # so that NumPy leaves `array @ value` to us

    def __init__(self, graph: Graph, name: str) -> None:
        self.graph, self.name = graph, name

    def node(self, operator: str, *others: Value | Number, **attributes: Any) -> Value:
        """What an operator of ONNX makes of this and other values.

        Args:
            operator: Its name.
            *others: Its further inputs; numbers become constants.
            **attributes: Of the operator.
        """
        g = self.graph
        names = [one.name if isinstance(one, Value) else g.constant(one).name for one in (self, *others)]
        made = f"v{len(g.nodes)}"
        g.nodes.append(g.onnx.helper.make_node(operator, names, [made], **attributes))
        return Value(g, made)

    def __add__(self, other: Value | Number) -> Value:
        return self.node("Add", other)

    def __radd__(self, other: Number) -> Value:
        return self.node("Add", other)

    def __sub__(self, other: Value | Number) -> Value:
        return self.node("Sub", other)

    def __rsub__(self, other: Number) -> Value:
        return self.graph.constant(other).node("Sub", self)

    def __mul__(self, other: Value | Number) -> Value:
        return self.node("Mul", other)

    def __rmul__(self, other: Number) -> Value:
        return self.node("Mul", other)

    def __truediv__(self, other: Value | Number) -> Value:
        return self.node("Div", other)

    def __rtruediv__(self, other: Number) -> Value:
        return self.graph.constant(other).node("Div", self)

    def __neg__(self) -> Value:
        return self.node("Neg")

    def __matmul__(self, other: Value | Number) -> Value:
        return self.node("MatMul", other)

    def __lt__(self, other: Value | Number) -> Value:
        return self.node("Less", other)

    def __gt__(self, other: Value | Number) -> Value:
        return self.node("Greater", other)

    def __and__(self, other: Value) -> Value:
        return self.node("And", other)

    def column(self, *numbers: int) -> Value:
        """Some columns.

        Args:
            *numbers: Which.

        Returns:
            (n, their number).
        """
        return self.node("Gather", self.graph.integers(list(numbers)), axis=1)

    @property
    def columns(self) -> _Columns:
        """`x, y, z = value.columns[:3]`: each (n, 1)."""
        return _Columns(self)

    def rows_of(self, table: Floats) -> Value:
        """Rows of a table of numbers, this value being their numbers.

        Args:
            table: (rows, columns).

        Returns:
            (n, columns).
        """
        return self.graph.constant(table).node("Gather", self, axis=0)

    def sum(self) -> Value:
        """(n, 1), the sum over the columns."""
        return self.node("ReduceSum", self.graph.integers([1]), keepdims=1)

    def squared(self) -> Value:
        """The square of each number."""
        return self.node("Mul", self)

    def least(self) -> Value:
        """(n, 1), the least over the columns."""
        return self.node("ReduceMin", axes=[1], keepdims=1)

    def where_least(self) -> Value:
        """(n,) the number of the column that is least."""
        return self.node("ArgMin", axis=1, keepdims=0)

    def at_least(self, least: float) -> Value:
        """No number below; NaN stays.

        Args:
            least: The bound.
        """
        return self.node("Max", least)

    def only_where(self, good: Value, otherwise: Value | float = np.nan) -> Value:
        """These numbers where a condition holds.

        Args:
            good: The condition.
            otherwise: What is there else.
        """
        other = otherwise if isinstance(otherwise, Value) else self.graph.constant(otherwise)
        return good.node("Where", self, other)

    def sqrt(self) -> Value:
        """The square root."""
        return self.node("Sqrt")

    def exp(self) -> Value:
        """The exponential."""
        return self.node("Exp")

    def log(self) -> Value:
        """The natural logarithm."""
        return self.node("Log")

    def nothing(self) -> Value:
        """(n, 1) zero, NaN where a number of the row is not finite."""
        return (self * 0.0).sum()


class _Columns:
    """The columns of a value, by their numbers."""

    def __init__(self, value: Value) -> None:
        self.value = value

    def __getitem__(self, part: slice) -> list[Value]:
        return [self.value.column(number) for number in range(part.start or 0, part.stop)]


def side_by_side(values: list[Value]) -> Value:
    """Tables beside each other.

    Args:
        values: Each (n, columns).

    Returns:
        (n, all columns).
    """
    return values[0].node("Concat", *values[1:], axis=1)


def angle(across: Value, along: Value) -> tuple[Value, Value]:
    """`atan2(across, along)` for `across` that is not negative.

    Args:
        across: (n, 1).
        along: (n, 1).

    Returns:
        The angle (n, 1), in radians, and the length hypot(across, along).
    """
    double, single = 11, 1  # numbers of TensorProto.DOUBLE and FLOAT
    length = (across.squared() + along.squared()).sqrt()
    half = (across / (length + along)).node("Cast", to=single).node("Atan").node("Cast", to=double)
    near = half * 2.0
    off = (across * near.node("Cos") - along * near.node("Sin")) / length  # the sine of what is missing
    return near + off + off * off.squared() * (1 / 6), length


def kernel(X: Value, points: Floats, lengthscale: Floats, shape: str) -> tuple[Value, Value]:
    """The correlation of rows with known points, as `implicam.gp.kernels` computes it, and its slope.

    Args:
        X: (n, d).
        points: (m, d).
        lengthscale: (d,).
        shape: A key of `implicam.gp.SHAPES`.

    Returns:
        Correlation and slope, (n, m).
    """
    new, own = X / lengthscale, points / lengthscale
    squares = new.squared().sum() + np.sum(own**2, axis=1)[None] - 2.0 * (new @ own.T)
    squares = squares.at_least(0.0)
    if shape == "squared-exponential":
        found = (squares * -0.5).exp()
        return found, found
    s = (squares * 5.0).sqrt()
    decay = (-s).exp()
    return (s + squares * (5 / 3) + 1.0) * decay, (s + 1.0) * decay * (5 / 3)


def solve_lower(K: Value, L: Floats) -> Value:
    """`L^-1 k` of each row k: by the inverse, with one step of refinement, as exact as a triangular solution.

    Args:
        K: (n, m), rows k.
        L: (m, m) lower triangular.

    Returns:
        (n, m).
    """
    inverse = np.tril(np.linalg.inv(L)).T
    found = K @ inverse
    return found + (K - found @ L.T) @ inverse
