"""Machine code: taken from a function that Numba has compiled, kept in a file, loaded by LLVM alone.

Importing Numba takes longer than everything else that the first step of an environment needs; code that was compiled before does
without it. What it calls outside of itself are the functions of C's math library and those of `PYTHON`.
"""

import ctypes
import hashlib
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm

PYTHON = (
    "PyFloat_AsDouble",
    "PyFloat_FromDouble",
    "PyBool_FromLong",
    "PyLong_AsVoidPtr",
    "PyTuple_New",
    "PyTuple_SetItem",
)
MATH = {
    *("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
    *("exp", "exp2", "expm1", "log", "log2", "log10", "log1p", "pow", "sqrt", "cbrt", "hypot", "erf", "erfc"),
    *(
        "fabs",
        "floor",
        "ceil",
        "trunc",
        "rint",
        "round",
        "fmod",
        "fmin",
        "fmax",
        "ldexp",
        "memset",
        "memcpy",
        "memmove",
    ),
}
NAME = "compiled"  # of the function in its file
RELEASE = "NRT_MemInfo_call_dtor"  # frees an array that Numba allocated; there are none here

# Numba's functions return a status and write their result; a method of Python returns it.
STUBS = f"""
define void @{RELEASE}(ptr %memory) {{
    ret void
}}
"""
METHOD = """
declare i32 @{name}(ptr, ptr, ptr, ptr)

define ptr @{method}(ptr %self, ptr %argument) {{
    %result = alloca ptr
    %error = alloca ptr
    %status = call i32 @{name}(ptr %result, ptr %error, ptr %self, ptr %argument)
    %object = load ptr, ptr %result
    ret ptr %object
}}
"""

_kept: list[Any] = []  # what lives as long as the process: the code, and what Python's functions refer to


@cache
def processor() -> str:
    """Short hash of what code depends on beside its source: the processor and the version of LLVM."""
    features = llvm.get_host_cpu_features().flatten()
    text = f"{llvm.llvm_version_info} {llvm.get_process_triple()} {llvm.get_host_cpu_name()} {features}"
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def of(dispatcher: Any, method: bool) -> bytes:
    """The object code of Numba's only specialisation of a function, under the name `NAME`.

    `method`: it takes and returns Python objects, (self, argument) -> result. Raises RuntimeError for a function that calls what
    is not allowed, an allocation of memory above all.
    """
    (compiled,) = dispatcher.overloads.values()
    name = compiled.fndesc.llvm_func_name
    module = llvm.parse_bitcode(compiled.library._final_module.as_bitcode())
    module.get_function(name).name = inner = "function" if method else NAME
    if RELEASE in {function.name for function in module.functions}:
        module.link_in(_parsed(STUBS, module))
    if method:
        module.link_in(_parsed(METHOD.format(name=inner, method=NAME), module))
    for function in module.functions:
        if not function.is_declaration and function.name != NAME:
            function.linkage = llvm.Linkage.internal
    machine = _machine()
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.add_strip_dead_prototype_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    called = {f.name for f in module.functions if f.is_declaration and not f.name.startswith("llvm.")}
    if unknown := called - MATH - set(PYTHON):
        raise RuntimeError(f"{dispatcher.py_func.__qualname__} must not call {sorted(unknown)}.")
    return bytes(machine.emit_object(module))


def load(code: bytes) -> int:
    """Where the function begins in memory. Raises RuntimeError for what is no object code."""
    engine = llvm.create_mcjit_compiler(_parsed("", None), _machine())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    address = int(engine.get_function_address(NAME))
    if not address:
        raise RuntimeError(f"no function {NAME} in the object code.")
    _kept.append(engine)
    return address


def read(path: Path) -> int | None:
    """`load` of a file; None if there is none that can be read."""
    try:
        return load(path.read_bytes())
    except (OSError, RuntimeError):
        return None


@cache
def _target() -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_triple(llvm.get_process_triple())


def _machine() -> Any:
    """For this processor, as Numba compiles for it."""
    x86 = _target().name.startswith("x86")
    return _target().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        reloc="static" if x86 else "default",
        codemodel="jitdefault",
        jit=True,
    )


def _parsed(text: str, like: Any) -> Any:
    module = llvm.parse_assembly(text)
    module.triple = llvm.get_process_triple() if like is None else like.triple
    if like is not None:
        module.data_layout = like.data_layout
    return module


class Definition(ctypes.Structure):
    """PyMethodDef of Python's C API."""

    _fields_ = (
        ("name", ctypes.c_char_p),
        ("function", ctypes.c_void_p),
        ("flags", ctypes.c_int),
        ("doc", ctypes.c_char_p),
    )


ONE_ARGUMENT = 8  # METH_O


def method(name: str, address: int, self: object) -> Any:
    """The Python function of one argument that calls the code at this address with `self` before it."""
    definition = Definition(name.encode(), address, ONE_ARGUMENT, None)
    _kept.append(definition)
    make = ctypes.pythonapi.PyCFunction_NewEx
    make.restype, make.argtypes = ctypes.py_object, (ctypes.c_void_p, ctypes.py_object, ctypes.c_void_p)
    return make(ctypes.addressof(definition), self, None)
