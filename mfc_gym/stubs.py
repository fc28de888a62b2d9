"""What lies between Python and the machine code of a function of Numba's, in the language of LLVM.

Numba's functions return a status and write their result; of an array they take owner, parent, number of items, bytes of an item,
data, shape and strides. A stub calls `FUNCTION` so and is itself called by C's rules under the name `STUB`.
"""

from collections.abc import Sequence

FUNCTION, STUB = "function", "stub"
NUMBERS = {  # Numba's name -> LLVM's type, bytes in memory, code of Python's `struct` for a slot of 8 bytes
    "float64": ("double", 8, "d"),
    "int64": ("i64", 8, "q"),
    "uint64": ("i64", 8, "Q"),
    "boolean": ("i8", 1, "q"),
}

METHOD = f"""
declare void @PyErr_BadInternalCall()
declare i32 @{FUNCTION}(ptr, ptr, ptr, ptr)

define ptr @{STUB}(ptr %self, ptr %argument) {{
    %result = alloca ptr
    %error = alloca ptr
    %status = call i32 @{FUNCTION}(ptr %result, ptr %error, ptr %self, ptr %argument)
    %failed = icmp ne i32 %status, 0
    br i1 %failed, label %raise, label %return
raise:
    call void @PyErr_BadInternalCall()
    ret ptr null
return:
    %object = load ptr, ptr %result
    ret ptr %object
}}
"""


def entry(arguments: Sequence[tuple[str, int]]) -> str:
    """Of arguments (name, dimensions) that are packed one after the other: a number, or address and shape of an array."""
    lines: list[str] = []
    given = ["ptr %result", "ptr %error"]
    slots = 0

    def load(kind: str) -> str:
        nonlocal slots
        lines.append(f"%at{slots} = getelementptr i64, ptr %packed, i64 {slots}")
        lines.append(f"%value{slots} = load {kind}, ptr %at{slots}")
        slots += 1
        return f"%value{slots - 1}"

    for name, dimensions in arguments:
        kind, size, _ = NUMBERS[name]
        if not dimensions:
            given.append(f"{kind} {load(kind)}")
            continue
        data, shape = load("ptr"), [load("i64") for _ in range(dimensions)]
        items, strides = shape[-1], [str(size)]
        for k in range(dimensions - 2, -1, -1):
            lines.append(f"%stride{slots}.{k} = mul i64 {strides[0]}, {shape[k + 1]}")
            lines.append(f"%items{slots}.{k} = mul i64 {items}, {shape[k]}")
            items, strides = f"%items{slots}.{k}", [f"%stride{slots}.{k}", *strides]
        numbers = ", ".join(f"i64 {value}" for value in (*shape, *strides))
        given.append(f"ptr null, ptr null, i64 {items}, i64 {size}, ptr {data}, {numbers}")
    types = ", ".join(argument.rpartition(" ")[0] for argument in ", ".join(given).split(", "))
    body = "\n    ".join([*lines, f"%status = call i32 @{FUNCTION}({', '.join(given)})", "ret i32 %status"])
    return f"""
declare i32 @{FUNCTION}({types})

define i32 @{STUB}(ptr %packed, ptr %result) {{
    %error = alloca ptr
    {body}
}}
"""
