"""Generated modules: written once, compiled by Numba, cached on disk, loaded by the hash of what they came from."""

import hashlib
import importlib.util
import os
import platform
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any

_lock = threading.RLock()


class Kernel(ModuleType):
    """A generated module. It pickles as its own source: what holds one can be copied and sent to another process."""

    def __reduce__(self) -> tuple[Any, ...]:
        return restore, (self.__name__, self.__dict__.get("SOURCE") or Path(str(self.__file__)).read_text("utf-8"))


@cache
def cache_directory() -> Path | None:
    """$MFC_GYM_CACHE, else mfc_gym in the user's cache directory; None, with one warning, if it is not writable."""
    try:
        given = os.environ.get("MFC_GYM_CACHE")
        folder = Path(given or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mfc_gym").absolute()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home directory
        warnings.warn(
            f"Kernels are compiled in every process, there is no writable cache: {error}. "
            "Set MFC_GYM_CACHE to a writable folder.",
            stacklevel=2,
        )
        return None
    return folder


@cache
def fingerprint(*paths: Path) -> str:
    """Hash of these source files and of everything else that generated code depends on."""
    digest = hashlib.sha256()
    for text in (platform.python_version(), version("numba"), version("sympy")):
        digest.update(text.encode() + b"\0")
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def files(package: str, *modules: str) -> tuple[Path, ...]:
    """Source files of modules whose compiled functions a generated module calls."""
    return tuple(Path(__file__).parents[1] / package / f"{module}.py" for module in modules)


def key(*parts: str) -> str:
    """Short hash of the parts."""
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]


def load(name: str, source: Callable[[], str]) -> ModuleType:
    """The generated module `name`; its text comes from `source()` only if it is not in the cache yet."""
    with _lock:
        if name in sys.modules:
            return sys.modules[name]
        folder = cache_directory()
        if folder is None:
            module: ModuleType = Kernel(name)
            module.__dict__["SOURCE"] = source()
            code = module.__dict__["SOURCE"].replace("cache=True, ", "")
            return _execute(module, lambda: exec(compile(code, f"<{name}>", "exec"), module.__dict__))
        path = folder / f"{name}.py"
        if not path.exists():
            write(path, source().encode("utf-8"))
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        module.__class__ = Kernel
        return _execute(module, partial(spec.loader.exec_module, module))


def restore(name: str, source: str) -> ModuleType:
    """The module again, from what `Kernel.__reduce__` kept."""
    return load(name, lambda: source)


def write(path: Path, content: bytes) -> None:
    """Complete or not at all, also when several processes write the same file or the power fails."""
    file = tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False)  # noqa: SIM115
    try:
        with file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(file.name, path)
    except BaseException:
        os.unlink(file.name)
        raise


def _execute(module: ModuleType, run: Callable[[], None]) -> ModuleType:
    """Runs the module's text; a module that fails is not left behind."""
    sys.modules[module.__name__] = module
    try:
        run()
    except BaseException:
        del sys.modules[module.__name__]
        raise
    return module
