"""Compiled functions that need Numba only where something is compiled.

`njit` is Numba's, put off until the function is called or another one that calls it is compiled. An `entry` is what the
environments call: its machine code comes from the cache, without Numba, whose import takes longer than the rest of a first step.
"""

import ctypes
import os
import re
import struct
import sys
import threading
from collections.abc import Callable, Sequence
from functools import cached_property, partial, update_wrapper
from pathlib import Path
from typing import Any

import numpy as np

from mfc_gym import kernels, machine_code, stubs

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")  # Numba's own switch
_lock = threading.RLock()


class Function:
    """A function that Numba compiles when it is needed; other compiled functions may call it."""

    __name__: str

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.py_func = function
        self._options = options
        update_wrapper(self, function)

    @cached_property
    def dispatcher(self) -> Any:
        """Numba's."""
        from numba import njit

        return njit(**self._options)(self.py_func)

    @property
    def _numba_type_(self) -> Any:
        """What Numba takes it for where another function calls it."""
        from numba import typeof

        return typeof(self.dispatcher)

    def __call__(self, *arguments: Any) -> Any:
        return self.dispatcher(*arguments)

    def __reduce__(self) -> str:
        return self.py_func.__qualname__


def njit(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Numba's decorator of this name, put off."""
    return partial(njit, **options) if function is None else Function(function, options)


TYPE = re.compile(r"(\w+)(\[(:, )?::1\])?")  # of a signature: a number, or a C-contiguous array with one or two axes
DTYPES = {
    name: np.dtype(kind) for name, kind in (("float64", float), ("int64", "i8"), ("uint64", "u8"), ("boolean", bool))
}
RESULTS: dict[str, Any] = {
    "void": None,
    "float64": ctypes.c_double,
    "int64": ctypes.c_int64,
    "boolean": ctypes.c_bool,
}
_NOTHING = ctypes.c_void_p()  # where Numba writes the result of a function that has none
_AT_NOTHING = ctypes.addressof(_NOTHING)
_bytes = (ctypes.c_char * 0).from_buffer  # of a writable, C-contiguous array


class Coded(Function):
    """A function with machine code of its own, from the cache or compiled now."""

    signature = ""
    stub = ""

    def compiled(self) -> Any:
        """A dispatcher of Numba's with the one specialisation."""
        from numba import njit

        return njit(self.signature, **self._options)(self.py_func)

    @cached_property
    def address(self) -> int:
        """Where the code is in memory."""
        with _lock:
            folder, text = kernels.cache_directory(), getattr(sys.modules.get(self.__module__), "__file__", None)
            path = None
            if folder is not None and text is not None and Path(text).parent == folder:
                path = folder / f"{self.__module__}.{self.py_func.__name__}.{machine_code.key()}.o"
            found = None if path is None else machine_code.read(path)
            if found is None:
                code = machine_code.of(self.compiled(), self.stub)
                if path is not None:
                    machine_code.write(path, code)
                found = machine_code.load(code)
            return found


class Entry(Coded):
    """A function of arrays and numbers, of just these types; it must not allocate memory.

    Raises TypeError for arguments of other types, ArithmeticError where the function raises anything.
    """

    def __init__(self, function: Callable[..., Any], signature: str, options: dict[str, Any]) -> None:
        super().__init__(function, options)
        self.signature = signature
        result, arguments = signature.rstrip(")").split("(")
        self._result = RESULTS[result]
        self._types = [(m[1], 2 if m[3] else 1 if m[2] else 0) for m in TYPE.finditer(arguments)]
        self.stub = stubs.entry(self._types)

    @cached_property
    def _call(self) -> Callable[..., int]:
        return ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_char_p, ctypes.c_void_p)(self.address)

    def __call__(self, *arguments: Any) -> Any:
        if INTERPRETED:
            return self.py_func(*arguments)
        return self.run(self.packed(arguments, 0))

    def bind(self, *arguments: Any) -> "Bound":
        """The function of the remaining arguments."""
        return Bound(self, (), b"").bind(*arguments)

    def packed(self, arguments: Sequence[Any], first: int) -> bytes:
        """These arguments, the first of which has this number, as the stub takes them."""
        if len(arguments) > len(self._types) - first:
            raise TypeError(f"{self.__name__} takes {len(self._types)} arguments, got more.")
        values: list[Any] = []
        for (name, dimensions), value in zip(self._types[first:], arguments, strict=False):
            if not dimensions:
                values.append(value)
                continue
            shape, dtype = value.shape, value.dtype
            if (dtype is not DTYPES[name] and dtype != DTYPES[name]) or len(shape) != dimensions:
                raise TypeError(
                    f"{self.__name__} takes arrays of {name} with {dimensions} axes, got {value.dtype} of shape {shape}."
                )
            values += (ctypes.addressof(_bytes(value)), *shape)
        return self._structs[first][len(arguments)].pack(*values)

    @cached_property
    def _size(self) -> int:
        """Bytes of all arguments."""
        return self._structs[0][-1].size

    @cached_property
    def _structs(self) -> list[list[struct.Struct]]:
        """[i][m] packs m arguments from the one of number i on."""
        codes = ["P" + "q" * dimensions if dimensions else stubs.NUMBERS[name][2] for name, dimensions in self._types]
        ends = range(len(codes) + 1)
        return [[struct.Struct("".join(codes[i : i + m])) for m in ends] for i in ends]

    def run(self, packed: bytes) -> Any:
        """The function of these arguments."""
        self.require_all(packed)
        if self._result is None:
            return self.check(self._call(packed, _AT_NOTHING))
        result = self._result()
        self.check(self._call(packed, ctypes.addressof(result)))
        return result.value

    def require_all(self, packed: bytes) -> None:
        """Raises TypeError unless these are all arguments."""
        if len(packed) != self._size:
            raise TypeError(f"{self.__name__} takes {len(self._types)} arguments, got fewer.")

    def check(self, status: int) -> None:
        """Raises ArithmeticError if this is the status of a failure."""
        if status:
            raise ArithmeticError(f"{self.__name__} of {self.__module__} failed.")


class Bound:
    """An entry with its first arguments, which live as long as it does."""

    def __init__(self, entry: Entry, arguments: tuple[Any, ...], packed: bytes) -> None:
        self._entry, self._arguments, self._packed = entry, arguments, packed

    def bind(self, *arguments: Any) -> "Bound":
        """The function of the remaining arguments."""
        more = b"" if INTERPRETED else self._entry.packed(arguments, len(self._arguments))
        return Bound(self._entry, (*self._arguments, *arguments), self._packed + more)

    def extended(self, like: "Bound") -> "Bound":
        """With the further arguments that another one has."""
        more = like._arguments[len(self._arguments) :]
        return Bound(self._entry, (*self._arguments, *more), self._packed + like._packed[len(self._packed) :])

    def __call__(self, *arguments: Any) -> Any:
        if INTERPRETED:
            return self._entry.py_func(*self._arguments, *arguments)
        more = self._entry.packed(arguments, len(self._arguments)) if arguments else b""
        return self._entry.run(self._packed + more)

    @property
    def arguments(self) -> bytes:
        """All of them, packed. Raises TypeError if some are missing."""
        self._entry.require_all(self._packed)
        return self._packed

    @property
    def address(self) -> int:
        """Where the code is in memory."""
        return self._entry.address

    def check(self, status: int) -> None:
        """Raises ArithmeticError if this is the status of a failure."""
        self._entry.check(status)


class Method(Coded):
    """A function (memory (m,), number) -> (number, bool, bool) that Python calls as fast as its own."""

    signature = "voidptr(voidptr, voidptr)"
    stub = stubs.METHOD

    def __init__(self, function: Callable[..., Any], size: int, options: dict[str, Any]) -> None:
        super().__init__(function, options)
        self._size = size

    def bind(self, memory: Any) -> Callable[[float], tuple[float, bool, bool]]:
        """The function of the number, which must be a float; the memory must live as long as it does.

        It raises SystemError where the function raises anything.
        """
        if INTERPRETED:
            return partial(self.py_func, memory)
        if memory.dtype != np.float64 or memory.shape != (self._size,):
            raise TypeError(
                f"{self.__name__} takes float64 of shape ({self._size},), got {memory.dtype} {memory.shape}."
            )
        return machine_code.method(self.__name__, self.address, ctypes.addressof(_bytes(memory)))

    def compiled(self) -> Any:
        from numba import carray, njit, types
        from numba.core.typing import signature

        def external(name: str, result: Any, *arguments: Any) -> Any:
            return types.ExternalFunction(name, signature(result, *arguments))

        pointer, function, size = types.voidptr, self.dispatcher, self._size
        address_of = external("PyLong_AsVoidPtr", pointer, pointer)
        number_of = external("PyFloat_AsDouble", types.float64, pointer)
        from_number = external("PyFloat_FromDouble", pointer, types.float64)
        from_bool = external("PyBool_FromLong", pointer, types.long_)
        new_tuple = external("PyTuple_New", pointer, types.intp)
        set_item = external("PyTuple_SetItem", types.intc, pointer, types.intp, pointer)

        @njit(self.signature)
        def call(self, argument):  # type: ignore[no-untyped-def]
            value, first, second = function(carray(address_of(self), (size,), np.float64), number_of(argument))
            result = new_tuple(3)
            set_item(result, 0, from_number(value))
            set_item(result, 1, from_bool(first))
            set_item(result, 2, from_bool(second))
            return result

        return call


def bind_all(functions: Sequence[Bound], *arguments: Any) -> list[Bound]:
    """`bind` of the same further arguments to functions that are one entry with as many first arguments."""
    first = functions[0].bind(*arguments)
    return [first, *(function.extended(first) for function in functions[1:])]


def entry(signature: str, **options: Any) -> Any:
    """Decorates a function of the types that the signature names, as Numba writes them: "void(float64[:, ::1], int64)"."""
    return lambda function: Entry(function, signature, options)


def method(size: int, **options: Any) -> Any:
    """Decorates a function of a memory of this size and a number."""
    return lambda function: Method(function, size, options)
