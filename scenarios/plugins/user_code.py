"""A user's Python file as a module that imports what lies beside it, and the files that it has imported.

`load` runs a file as a module of a package. The package has a name that is made of the file's path, and the file's own
folder as its place, so two files in two folders, each with a helper.py, get their own. `from . import helper` is plain
Python there. `import helper` means the same, also inside functions: when a source is compiled, the package's name is
put before the names of modules that lie beside the file. The standard library and Sortie come before the folder,
installed packages after it, as for a script.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
import sys
import threading
from collections.abc import Mapping, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader, FileFinder, ModuleSpec, SourceFileLoader
from importlib.metadata import packages_distributions
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

PREFIX = "sortie_user_"
"""The first part of the name of every module that `load` registers."""
_INSTALLED = {"site-packages", "dist-packages"}
_LOADING = threading.RLock()


def load(path: Path) -> ModuleType:
    """Run a file as it is now, as a new module, with new modules for all that it imports from its folder.

    Args:
        path: the file.

    Raises:
        Exception: what the file, or a module that it imports, raises.
    """
    path = path.resolve()
    package = ModuleType(_package(path))
    package.__path__ = [str(path.parent)]
    name = f"{package.__name__}.{path.stem.replace('.', '_')}"
    spec = importlib.util.spec_from_file_location(name, path, loader=_Loader(name, str(path)))
    assert spec is not None and spec.loader is not None  # noqa: S101, PT018 - a loader was given
    module = importlib.util.module_from_spec(spec)
    with _LOADING:
        for old in [name for name in sys.modules if _top(name) == package.__name__]:
            del sys.modules[old]
        sys.modules.update({package.__name__: package, name: module})
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[package.__name__], sys.modules[name]
            raise
    return module


def is_users(name: object) -> bool:
    """Whether this is the name of a module that `load` registered."""
    return str(name).startswith(PREFIX)


def is_loaded(path: Path) -> bool:
    """Whether `load` has run a file."""
    return _package(path.resolve()) in sys.modules


def imported_files(path: Path) -> tuple[Path, ...]:
    """A file and every module that it has imported, directly or through others, sorted.

    Modules that are loaded now count, and those beside the file that its functions will import by their plain names.
    Modules of the standard library, of installed packages (site-packages) and of Sortie are left out.
    """
    return tuple(sorted(_imports(path.resolve())))


def imported_packages(path: Path) -> set[str]:
    """The installed packages that `imported_files` of a file import, by their names on the index."""
    return {
        package
        for names in _imports(path.resolve()).values()
        for name in names
        for package in _offered_by().get(name, ())
    }


# --- running ---------------------------------------------------------------------------------------


class _Loader(SourceFileLoader):
    """Runs a source as it is now: it neither reads nor writes compiled files."""

    def get_code(self, fullname: str) -> CodeType:
        path = self.get_filename(fullname)
        tree = ast.parse(self.get_data(path), path)
        package = _top(fullname)
        (folder,) = sys.modules[package].__path__
        code: CodeType = self.source_to_code(_Beside(package, folder).visit(tree), path)
        return code


class _Beside(ast.NodeTransformer):
    """Puts the package's name before the modules beside a file in plain imports."""

    def __init__(self, package: str, folder: str) -> None:
        self._package, self._folder = package, folder

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.ImportFrom:
        if not node.level and node.module is not None and _is_beside(self._folder, _top(node.module)):
            node.module = f"{self._package}.{node.module}"
        return node

    def visit_Import(self, node: ast.Import) -> list[ast.stmt]:
        found: list[ast.stmt] = []
        for alias in node.names:
            top = _top(alias.name)
            if not _is_beside(self._folder, top):
                found.append(ast.Import([alias]))
                continue
            found.append(ast.Import([ast.alias(f"{self._package}.{alias.name}", alias.asname)]))
            if alias.asname is None:
                found.append(ast.ImportFrom(self._package, [ast.alias(top)], 0))
        return [ast.fix_missing_locations(ast.copy_location(statement, node)) for statement in found]


class _Finder(MetaPathFinder):
    """Finds the modules of users' packages; Python's own finder would have them by other loaders."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        if not is_users(name):
            return None
        return next((spec for folder in path or () if (spec := _found(folder, name)) is not None), None)


sys.meta_path.insert(0, _Finder())


def _package(path: Path) -> str:
    return PREFIX + hashlib.sha256(str(path).encode()).hexdigest()[:16]


def _top(name: str) -> str:
    return name.partition(".")[0]


def _found(folder: str, name: str) -> ModuleSpec | None:
    """Where a module is in a folder; a folder without __init__.py counts as in Python."""
    return FileFinder(folder, (ExtensionFileLoader, EXTENSION_SUFFIXES), (_Loader, [".py"])).find_spec(name)


def _is_pythons(top: str) -> bool:
    """Whether a name is the standard library's or Sortie's, whatever lies in the folder."""
    return top == "sortie" or top in sys.stdlib_module_names


def _is_beside(folder: str, top: str) -> bool:
    """Whether a name means a module in a user's folder.

    A folder without __init__.py counts only where no installed package has its name, as everywhere in Python.
    """
    found = None if _is_pythons(top) else _found(folder, top)
    return found is not None and (found.loader is not None or importlib.util.find_spec(top) is None)


# --- what was loaded -------------------------------------------------------------------------------


def _imports(path: Path) -> Mapping[Path, set[str]]:
    """A file and the modules that it has imported: by their files, the first names of what they import from outside."""
    loaded = [(_top(name), file) for name, module in tuple(sys.modules.items()) if (file := _file(name, module))]
    beside = {file for top, file in loaded if top == _package(path)}
    found: dict[Path, set[str]] = {}
    waiting = {path}
    while waiting:
        here = waiting.pop()
        named = {top for top in _named(here) if not _is_pythons(top)}
        if here in beside:
            near = {top for top in named if _is_beside(str(path.parent), top)}
            origins = {spec.origin for top in near if (spec := _found(str(path.parent), top)) is not None}
            beside |= {Path(origin) for origin in origins if origin is not None}
            waiting |= beside - found.keys()
            named -= near
        found[here] = named
        tops = named | {top for top, file in loaded if file == here}  # the modules of its own package
        waiting |= {file for top, file in loaded if top in tops} - found.keys()
    return found


def _file(name: str, module: Any) -> Path | None:
    """The file of a loaded module, unless it is of the standard library, of an installed package or of Sortie."""
    file = None if _is_pythons(_top(name)) else getattr(module, "__file__", None)
    if (
        not isinstance(file, str) or not Path(file).is_absolute()
    ):  # torch makes modules with names of files that are none
        return None
    return None if _INSTALLED & set(Path(file).parts) else Path(file)


def _named(path: Path) -> set[str]:
    """The first names of what a source imports, also inside functions."""
    try:
        nodes = [*ast.walk(ast.parse(path.read_bytes()))]
    except (SyntaxError, ValueError):  # a compiled module
        return set()
    plain = {_top(alias.name) for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    return plain | {_top(n.module) for n in nodes if isinstance(n, ast.ImportFrom) and n.module and not n.level}


@functools.cache
def _offered_by() -> Mapping[str, list[str]]:
    """The installed packages by the modules that they offer."""
    return packages_distributions()
