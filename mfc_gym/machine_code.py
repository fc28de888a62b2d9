"""Machine code: taken from a function that Numba has compiled, kept in a file, loaded by LLVM alone.

Importing Numba takes longer than everything else that the first step of an environment needs; code that was compiled before does
without it. What it calls outside of itself are functions of C's library and those of `PYTHON`.
"""

import ctypes
import hashlib
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm

from mfc_gym import kernels
from mfc_gym.stubs import FUNCTION, STUB

PYTHON = {  # what a method calls of Python's C API
    *("PyFloat_AsDouble", "PyFloat_FromDouble", "PyBool_FromLong"),
    *("PyLong_AsVoidPtr", "PyTuple_New", "PyTuple_SetItem", "PyErr_BadInternalCall"),
}
STANDARD = {"numba_gamma": "tgamma", "numba_ldexp": "ldexp"}  # functions of Numba's own -> the same of C's library
RELEASE = "NRT_MemInfo_call_dtor"  # frees an array that Numba allocated; there are none here
RELEASE_NOTHING = f"""
define void @{RELEASE}(ptr %memory) {{
    ret void
}}
"""

_engines: list[Any] = []  # the code lives as long as these


@cache
def key() -> str:
    """Short hash of what code depends on beside its source: the processor, LLVM, and how the code is made and called."""
    parts = llvm.llvm_version_info, llvm.get_process_triple(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features()
    return kernels.key(
        *map(str, parts), kernels.fingerprint(*kernels.files("mfc_gym", "machine_code", "stubs", "compiled"))
    )


def of(dispatcher: Any, stub: str) -> bytes:
    """The object code of Numba's only specialisation of a function behind this stub.

    Raises RuntimeError for a function that calls what is not allowed, an allocation of memory above all.
    """
    (compiled,) = dispatcher.overloads.values()
    module = llvm.parse_bitcode(compiled.library._final_module.as_bitcode())
    module.get_function(compiled.fndesc.llvm_func_name).name = FUNCTION
    if RELEASE in {function.name for function in module.functions}:
        module.link_in(_parsed(RELEASE_NOTHING))
    module.link_in(_parsed(stub))
    for function in module.functions:
        if not function.is_declaration and function.name != STUB:
            function.linkage = llvm.Linkage.internal
        elif function.name in STANDARD:
            function.name = STANDARD[function.name]
    machine = _machine()
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.add_strip_dead_prototype_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    called = {f.name for f in module.functions if f.is_declaration and not f.name.startswith("llvm.")}
    if unknown := {name for name in called - PYTHON if name.startswith("Py") or not hasattr(ctypes.pythonapi, name)}:
        raise RuntimeError(f"{dispatcher.py_func.__qualname__} must not call {sorted(unknown)}.")
    return bytes(machine.emit_object(module))


def load(code: bytes) -> int:
    """Where the function begins in memory. Raises RuntimeError for what is no object code."""
    engine = llvm.create_mcjit_compiler(_parsed(""), _machine())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    return _addresses(engine, STUB)[0]


def assembled(text: str, *names: str) -> list[int]:
    """Where these functions of a text in LLVM's language begin in memory."""
    return _addresses(llvm.create_mcjit_compiler(_parsed(text), _machine()), *names)


def _addresses(engine: Any, *names: str) -> list[int]:
    engine.finalize_object()
    found = [int(engine.get_function_address(name)) for name in names]
    if not all(found):
        raise RuntimeError(f"no functions {names} in the code.")
    _engines.append(engine)
    return found


def write(path: Path, code: bytes) -> None:
    """A file of the code behind its hash; a warning if it cannot be written, for the code is there all the same."""
    try:
        kernels.write(path, hashlib.sha256(code).digest() + code)
    except OSError as error:
        warnings.warn(f"Machine code was compiled but not kept: {error}.", stacklevel=2)


def read(path: Path) -> int | None:
    """`load` of a file; None if there is none, or a damaged one, which LLVM might not survive."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, code = content[:32], content[32:]
    return load(code) if hashlib.sha256(code).digest() == digest else None


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


def _parsed(text: str) -> Any:
    module, machine = llvm.parse_assembly(text), _machine()
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
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


@cache
def _definition(name: str, address: int) -> Definition:
    return Definition(name.encode(), address, ONE_ARGUMENT, None)


def method(name: str, address: int, self: object) -> Any:
    """The Python function of one argument that calls the code at this address with `self` before it."""
    make = ctypes.pythonapi.PyCFunction_NewEx
    make.restype, make.argtypes = ctypes.py_object, (ctypes.c_void_p, ctypes.py_object, ctypes.c_void_p)
    return make(ctypes.addressof(_definition(name, address)), self, None)
