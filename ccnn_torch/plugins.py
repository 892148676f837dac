"""A user's own class, named as `path/to/file.py:Name`."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import inspect
import os
import sys
import sysconfig
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from ccnn_torch.errors import CcnnError, InputError
from ccnn_torch.files.read import CONFIG_LIMIT, read_text

# Lines of this package, of Python and of installed packages are not reported: they are not the user's.
_OTHERS = (f"{Path(__file__).parent}{os.sep}", f"{sysconfig.get_path('stdlib')}{os.sep}", "<")

# The source being read, while it may name no code.
_SOURCE: ContextVar[str | None] = ContextVar("source", default=None)


def is_plugin(spec: str) -> bool:
    """Whether a name in a config means a class in a Python file."""
    return ".py:" in spec


def names_code(description: object) -> bool:
    """Whether what a model file holds of a machine names a class in a Python file, at any depth."""
    return is_plugin(str(description))


def permission(needed: bool) -> str:
    """The end of a command line that takes a model: ` --allow-code` where that names code, else nothing."""
    return " --allow-code" if needed else ""


@contextmanager
def code_refused(source: str, allow_code: bool = False) -> Iterator[None]:
    """Within it `load_plugin` runs nothing: a file from outside may name no code that its reader has not allowed.

    Args:
        source: what names the code, as the refusal begins: `identified.yaml: its key 'mechanism'`.
        allow_code: whether the user has allowed it. What an outer one refuses an inner one cannot allow.
    """
    if allow_code:
        yield
        return
    token = _SOURCE.set(source)
    try:
        yield
    finally:
        _SOURCE.reset(token)


def file_that_names() -> str | None:
    """The source being read, as given to `code_refused`, while it may name no code; None elsewhere."""
    return _SOURCE.get()


def class_hint(file: str) -> str:
    """What to write for a Python file that was named without a class; the file is read, not run."""
    try:
        tree = ast.parse(read_text(file, CONFIG_LIMIT, "write path/to/file.py:Name"))
    except InputError as reason:
        return str(reason)
    except SyntaxError as error:
        return f"{file} line {error.lineno} is no valid Python: {error.msg}"
    except (ValueError, RecursionError, MemoryError):
        return f"{file} is no valid Python: it has a NUL, or is nested too deeply"
    names = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    for node in tree.body:
        # NAME = Simulator(…), or a function that makes one.
        if (
            isinstance(node, ast.Assign)
            and isinstance(node.value, ast.Call)
            and "imulator" in ast.unparse(node.value.func)
        ):
            names += [target.id for target in node.targets if isinstance(target, ast.Name)]
    if not names:
        return f"{file}: names no class, and has none; write path/to/file.py:Name"
    return f"{file}: names no class; write {' or '.join(f'{file}:{name}' for name in names)}"


def failure(error: BaseException, label: str) -> str:
    """`fails at line N: KeyError: 'q1'`, the end of a sentence that `label` (`path/to/file.py:Name`) opens.

    The line is the innermost in the user's code; its file is named where it is not the label's.
    """
    frames = traceback.extract_tb(error.__traceback__)
    users = [f for f in frames if not f.filename.startswith(_OTHERS) and "site-packages" not in f.filename]
    where = ""
    if users:
        file = Path(users[-1].filename)
        own = file.resolve() == Path(label.rpartition(":")[0]).resolve()
        where = f" at line {users[-1].lineno}{'' if own else f' of {file}'}"
    text = (str(error).strip().splitlines() or [""])[0]
    return f"fails{where}: {type(error).__name__}{': ' if text else ''}{text}"


@contextmanager
def users_code(label: str, call: str = "") -> Iterator[None]:
    """Within it anything that a user's code raises becomes an InputError: `LABEL: CALL fails at line N: …`."""
    try:
        yield
    except CcnnError:
        raise
    except (Exception, SystemExit) as error:  # a user's code may raise anything
        raise InputError(f"{label}: {call}{failure(error, label)}") from error


def load_plugin(spec: str, also: tuple[type, ...] = ()) -> Any:
    """Run the file and return what it calls `Name`: something that can be called, or an object of a class of `also`.

    Raises:
        InputError: there is no such file or name in it, or the file cannot be run (the sentence names the line); or a
            file from outside names it, which is not allowed to run code (`code_refused`).
    """
    source = file_that_names()
    if source is not None:
        raise InputError(
            f"{source} names Python code, {spec}, which would run; look at that file, and if you trust it allow it: "
            "--allow-code (ccnn compensate, export, verify), allow_code=True (Python), mechanism_keys.allow_code=true "
            "(configs)"
        )
    file, _, name = spec.rpartition(":")
    path = Path(file)
    if not path.is_file():
        raise InputError(f"{spec}: there is no file {file}")
    # A name of its own, so that two users' files of the same name, or one called torch.py, do not collide.
    unique = f"_ccnn_torch_user_{hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:12]}"
    module_spec = importlib.util.spec_from_file_location(unique, path)
    if module_spec is None or module_spec.loader is None:
        raise InputError(f"{spec}: {file} is no Python file")
    module = importlib.util.module_from_spec(module_spec)
    sys.modules[unique] = module
    with users_code(spec, f"{file} "):
        try:
            module_spec.loader.exec_module(module)
        except SyntaxError as error:
            raise InputError(f"{spec}: {file} line {error.lineno} is no valid Python: {error.msg}") from error
        except ImportError as error:
            raise InputError(f"{spec}: {file} imports something that is not installed: {error}") from error
    found = getattr(module, name, None)
    if not callable(found) and not isinstance(found, also):
        classes = [n for n, o in vars(module).items() if inspect.isclass(o) and o.__module__ == module.__name__]
        classes += [n for n, o in vars(module).items() if isinstance(o, also)]
        raise InputError(f"{spec}: {file} has no class '{name}'; it has {', '.join(classes) or 'none'}")
    return found
