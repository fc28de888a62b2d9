"""Compiled functions that need Numba only where something is compiled.

`njit` is Numba's, put off until the function is called or another one that calls it is compiled. An `entry` is what the
environments call: its machine code comes from the cache, without Numba, whose import takes longer than the rest of a first step.
"""

import ctypes
import os
import re
import sys
import threading
from collections.abc import Callable
from functools import cached_property, partial, update_wrapper
from pathlib import Path
from typing import Any

import numpy as np

from mfc_gym import kernels, machine_code

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")  # Numba's own switch
_lock = threading.RLock()


class Function:
    """A function that Numba compiles when it is needed; other compiled functions may call it."""

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


ARRAY = re.compile(
    r"(\w+)(?:\[(:, )?::1\])?"
)  # of a signature: a number, or a C-contiguous array of one or two dimensions
NUMBERS: dict[str, tuple[Any, Any, Any]] = {  # name -> of C, of NumPy, of Python
    "float64": (ctypes.c_double, np.dtype(np.float64), float),
    "int64": (ctypes.c_int64, np.dtype(np.int64), int),
    "uint64": (ctypes.c_uint64, np.dtype(np.uint64), int),
    "boolean": (ctypes.c_bool, np.dtype(np.bool_), bool),
    "void": (ctypes.c_void_p, None, None),
}
_bytes = (ctypes.c_char * 0).from_buffer  # of a writable, C-contiguous array


class Coded(Function):
    """A function with machine code of its own, from the cache or compiled now."""

    signature = ""

    def compiled(self) -> Any:
        """Numba's dispatcher with the one specialisation."""
        self.dispatcher.compile(self.signature)
        return self.dispatcher

    @cached_property
    def address(self) -> int:
        """Where the code is in memory."""
        with _lock:
            folder, text = kernels.cache_directory(), getattr(sys.modules[self.__module__], "__file__", None)
            path = None
            if folder is not None and text is not None and Path(text).parent == folder:
                path = folder / f"{self.__module__}.{self.py_func.__name__}.{machine_code.processor()}.o"
            found = None if path is None else machine_code.read(path)
            if found is None:
                code = machine_code.of(self.compiled(), isinstance(self, Method))
                if path is not None:
                    kernels.write(path, code)
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
        self._result = NUMBERS[result][0]
        self._arguments = []
        for name, two, text in ((m[1], m[2], m[0]) for m in ARRAY.finditer(arguments)):
            dimensions = 0 if text == name else 2 if two else 1
            self._arguments.append((text, NUMBERS[name], dimensions))

    @cached_property
    def _call(self) -> Callable[..., int]:
        flat: list[Any] = []  # of an array: owner, parent, size, bytes of an item, data, shape, strides
        for _, (number, *_), dimensions in self._arguments:
            array = [ctypes.c_void_p, ctypes.c_void_p, *[ctypes.c_int64] * 2, ctypes.c_void_p]
            flat += [*array, *[ctypes.c_int64] * (2 * dimensions)] if dimensions else [number]
        return ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p, *flat)(self.address)

    def bind(self, *first: Any) -> Callable[..., Any]:
        """The function of the remaining arguments."""
        if INTERPRETED:
            return partial(self.py_func, *first)
        flat = self._flat(first, 0)

        def call(*others: Any, arrays: Any = first) -> Any:  # which must live as long as this does
            return self._run([*flat, *self._flat(others, len(first))])

        return call

    def __call__(self, *arguments: Any) -> Any:
        if INTERPRETED:
            return self.py_func(*arguments)
        if len(arguments) != len(self._arguments):
            raise TypeError(f"{self.__name__} takes {len(self._arguments)} arguments, got {len(arguments)}.")
        return self._run(self._flat(arguments, 0))

    def _flat(self, arguments: Any, first: int) -> list[Any]:
        flat: list[Any] = []
        for (text, (_, dtype, number), dimensions), value in zip(self._arguments[first:], arguments, strict=False):
            if not dimensions:
                flat.append(number(value))
                continue
            if value.dtype != dtype or value.ndim != dimensions:
                raise TypeError(f"{self.__name__} takes {text}, got {value.dtype} of shape {value.shape}.")
            flat += (
                None,
                None,
                value.size,
                value.itemsize,
                ctypes.addressof(_bytes(value)),
                *value.shape,
                *value.strides,
            )
        return flat

    def _run(self, flat: list[Any]) -> Any:
        result, error = self._result(), ctypes.c_void_p()
        if self._call(ctypes.addressof(result), ctypes.addressof(error), *flat):
            raise ArithmeticError(f"{self.__name__} of {self.__module__} failed.")
        return result.value


class Method(Coded):
    """A function (memory (m,), number) -> (number, bool, bool) that Python calls as fast as its own."""

    signature = "voidptr(voidptr, voidptr)"

    def __init__(self, function: Callable[..., Any], size: int, options: dict[str, Any]) -> None:
        super().__init__(function, options)
        self._size = size

    def bind(self, memory: Any) -> Callable[[float], tuple[float, bool, bool]]:
        """The function of the number, which must be a float; the memory must live as long as it does."""
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

        @njit
        def call(self, argument):  # type: ignore[no-untyped-def]
            value, first, second = function(carray(address_of(self), (size,), np.float64), number_of(argument))
            result = new_tuple(3)
            set_item(result, 0, from_number(value))
            set_item(result, 1, from_bool(first))
            set_item(result, 2, from_bool(second))
            return result

        call.compile(self.signature)
        return call


def entry(signature: str, **options: Any) -> Any:
    """Decorates a function of the types that the signature names, as Numba writes them: "void(float64[:, ::1], int64)"."""
    return lambda function: Entry(function, signature, options)


def method(size: int, **options: Any) -> Any:
    """Decorates a function of a memory of this size and a number."""
    return lambda function: Method(function, size, options)
