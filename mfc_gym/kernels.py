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
from functools import cache
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

_lock = threading.RLock()


@cache
def cache_directory() -> Path | None:
    """$MFC_GYM_CACHE, else mfc_gym in the user's cache directory; None (with one warning) where nothing can be written."""
    default = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mfc_gym"
    folder = Path(os.environ.get("MFC_GYM_CACHE") or default)
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder):
            pass
    except OSError as error:
        warnings.warn(
            f"Kernels are compiled in every process: the cache {folder} is not writable ({error.strerror}). "
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
            module = ModuleType(name)
            sys.modules[name] = module
            exec(compile(source().replace("cache=True, ", ""), f"<{name}>", "exec"), module.__dict__)
            return module
        path = folder / f"{name}.py"
        if not path.exists():
            with tempfile.NamedTemporaryFile("w", dir=folder, suffix=".tmp", delete=False) as file:
                file.write(source())
            os.replace(file.name, path)
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
        return module
