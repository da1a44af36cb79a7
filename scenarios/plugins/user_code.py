"""A user's Python file as a module that can import the modules beside it, and the files that such a module imports.

`load` runs a file. Its imports look in the file's own folder first, as they do for a script: `import helper` finds
helper.py beside it, `from . import helper` does too, and so do imports inside functions. Python's standard library and
Sortie itself always come first. Nothing is added to `sys.path`, and the modules are registered under names that the
modules of no other file can have. Two files in two folders, each with a helper.py of its own, therefore get their own.
`importlib.import_module` does not look in the folder.

`imported_files` reads the same imports from the sources, without running them.
"""

from __future__ import annotations

import ast
import builtins
import functools
import hashlib
import importlib
import importlib.util
import sys
import sysconfig
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import EXTENSION_SUFFIXES, ModuleSpec, SourceFileLoader
from importlib.metadata import packages_distributions
from pathlib import Path
from types import CodeType, ModuleType
from typing import NamedTuple

PREFIX = "sortie_user_"
"""The first part of the name of every module that `load` registers."""
_STDLIB = Path(sysconfig.get_path("stdlib"))
_INSTALLED = {"site-packages", "dist-packages"}
_LOADING = threading.RLock()


def load(path: Path) -> ModuleType:
    """Run a file as a new module, with new modules for all that it imports from its folder.

    Args:
        path: the file.

    Raises:
        Exception: what the file, or a module that it imports, raises.
    """
    return _Folder(path.resolve()).load()


def is_users(name: object) -> bool:
    """Whether this is the name of a module that `load` registered."""
    return str(name).startswith(PREFIX)


def imported_files(path: Path) -> tuple[Path, ...]:
    """A file and every module that it imports, directly or through others, sorted.

    Modules of the standard library, of installed packages (site-packages) and of Sortie are left out. Imports inside
    functions count, and so do `importlib.import_module` and `__import__` with a constant name. Three things are not
    seen: an import that is not found, a name that is worked out while the program runs, and a file read as data.
    """
    return tuple(sorted({source.path for source in _sources(path)}))


def imported_packages(path: Path) -> set[str]:
    """The installed packages of which a file and the modules beside it import something, by their names on the index."""
    imports = {(s.folder, name.partition(".")[0]) for s in _sources(path) for name, _, level in _named(s) if not level}
    names = {top for folder, top in imports if not (_is_pythons(top) or (folder and _is_beside(folder, top)))}
    return {package for name in names for package in _offered_by().get(name, ())}


# --- running ---------------------------------------------------------------------------------------


class _Folder(MetaPathFinder):
    """The modules of one run of a file, found in the file's folder."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._package = PREFIX + hashlib.sha256(str(path).encode()).hexdigest()[:16]
        self._main = f"{self._package}.{path.stem.replace('.', '_')}"
        package = ModuleType(self._package)
        package.__path__ = [str(path.parent)]
        self._modules = {self._package: package}
        self._beside: dict[str, bool] = {}
        self.builtins = vars(builtins) | {"__import__": self._import}

    def load(self) -> ModuleType:
        self._registered(self._main)
        return self._modules[self._main]

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Where a module of this run is. Python calls this while `_registered` imports."""
        if not name.startswith(f"{self._package}."):
            return None
        where = self._path if name == self._main else _find(path or (), name.rpartition(".")[2])
        if where is None:
            return None
        if where.is_dir():
            spec = ModuleSpec(name, None, is_package=True)
            spec.submodule_search_locations = [str(where)]
            return spec
        loader = _Loader(name, where, self) if where.suffix == ".py" else None
        return importlib.util.spec_from_file_location(name, where, loader=loader)

    def _import(
        self,
        name: str,
        globals: Mapping[str, object] | None = None,
        locals: Mapping[str, object] | None = None,
        fromlist: Sequence[str] | None = (),
        level: int = 0,
    ) -> ModuleType:
        """`__import__` as the modules of this run see it."""
        package, top = str((globals or {}).get("__package__")), name.partition(".")[0]
        if level and is_users(package):
            return self._registered(importlib.util.resolve_name("." * level + name, package), fromlist)
        if level or not self._is_beside(top):
            return __import__(name, globals, locals, fromlist or (), level)
        module = self._registered(f"{self._package}.{name}", fromlist)
        return module if fromlist else self._modules[f"{self._package}.{top}"]

    def _is_beside(self, top: str) -> bool:
        if top not in self._beside:
            self._beside[top] = _is_beside(self._path.parent, top)
        return self._beside[top]

    def _registered(self, name: str, fromlist: Sequence[str] | None = ()) -> ModuleType:
        """Import a module of this run by the name that it is registered under."""
        known = self._modules.get(name)
        if known is not None and all(hasattr(known, item) for item in fromlist or ()):
            return known
        with _LOADING:
            outermost = self not in sys.meta_path  # otherwise a module that is being imported imports another
            if outermost:
                for other in self._in_sys():  # another run of the same file
                    del sys.modules[other]
                sys.modules.update(self._modules)
                sys.meta_path.insert(0, self)
            try:
                return __import__(name, fromlist=fromlist) if fromlist else importlib.import_module(name)
            finally:
                self._modules.update({n: sys.modules[n] for n in self._in_sys()})
                if outermost:
                    sys.meta_path.remove(self)

    def _in_sys(self) -> list[str]:
        return [name for name in sys.modules if name.partition(".")[0] == self._package]


class _Loader(SourceFileLoader):
    """Runs a source as it is now: it neither reads nor writes compiled files."""

    def __init__(self, name: str, path: Path, folder: _Folder) -> None:
        super().__init__(name, str(path))
        self.folder = folder

    def get_code(self, fullname: str) -> CodeType:
        path = self.get_filename(fullname)
        return self.source_to_code(self.get_data(path), path)

    def exec_module(self, module: ModuleType) -> None:
        vars(module)["__builtins__"] = self.folder.builtins
        super().exec_module(module)


# --- finding ---------------------------------------------------------------------------------------


def _is_pythons(top: str) -> bool:
    """Whether a name is the standard library's or Sortie's, whatever lies in the folder."""
    return top == "sortie" or top in sys.stdlib_module_names


def _is_beside(folder: Path, top: str) -> bool:
    """Whether a name means a module in a user's folder.

    A folder without __init__.py counts only where no installed package has its name, as everywhere in Python.
    """
    found = None if _is_pythons(top) else _find([folder], top)
    return found is not None and (found.is_file() or _on_path(top) is None)


def _find(folders: Iterable[str | Path], name: str) -> Path | None:
    """A package's __init__.py, a module's file, or else a folder without __init__.py."""
    names = [f"{name}/__init__.py", *(name + suffix for suffix in (*EXTENSION_SUFFIXES, ".py"))]
    paths = [[Path(folder, file) for file in names] for folder in folders]
    files = (path for inside in paths for path in inside if path.is_file())
    return next(files, None) or next((path[0].parent for path in paths if path[0].parent.is_dir()), None)


def _on_path(top: str) -> ModuleSpec | None:
    """Where Python finds a module outside the user's folder."""
    try:
        return importlib.util.find_spec(top)
    except (ImportError, ValueError):
        return None


@functools.cache
def _offered_by() -> Mapping[str, list[str]]:
    """The installed packages by the modules that they offer."""
    return packages_distributions()


# --- reading ---------------------------------------------------------------------------------------


class _Source(NamedTuple):
    """A source file."""

    path: Path
    folder: Path | None
    """The user's folder, in which its imports look first; None for a module that Python found on `sys.path`."""


def _sources(path: Path) -> set[_Source]:
    """A file and every module that it imports, directly or through others."""
    waiting, found = [_Source(path.resolve(), path.resolve().parent)], set[_Source]()
    while waiting:
        source = waiting.pop()
        if source not in found:
            found.add(source)
            for name, item, level in _named(source):
                waiting += _chain(source, name, item, level)
    return found


def _named(source: _Source) -> Iterator[tuple[str, str, int]]:
    """What a source imports: the module, the name within it, and the number of dots before it."""
    try:
        tree = ast.parse(source.path.read_bytes())
    except (SyntaxError, ValueError):  # a compiled module, or a source that fails with this error when it is run
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, "", 0
        elif isinstance(node, ast.ImportFrom):
            for alias in node.names:
                yield node.module or "", alias.name, node.level
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called, name = getattr(node.func, "attr", getattr(node.func, "id", "")), node.args[0].value
            if called in ("import_module", "__import__") and isinstance(name, str) and name.strip("."):
                yield name.lstrip("."), "", len(name) - len(name.lstrip("."))


def _chain(source: _Source, name: str, item: str, level: int) -> Iterator[_Source]:
    """The packages on the way to a module, the module, and its submodule `item` (all of them for `*`)."""
    folder = source.folder
    folders: Sequence[str | Path]
    if level:
        folders = source.path.parents[level - 1 : level]
    else:
        top = name.partition(".")[0]
        if _is_pythons(top):
            return
        if folder is not None and _is_beside(folder, top):
            folders = [folder]
        else:
            folder, spec = None, _on_path(top)
            places = [] if spec is None else spec.submodule_search_locations or [spec.origin or ""]
            folders = [Path(place).parent for place in places]
    for part in [*name.split("."), item]:
        if part in ("", "*"):
            continue
        found = _find(folders, part)
        if found is None or (folder is None and (_INSTALLED & set(found.parts) or found.is_relative_to(_STDLIB))):
            return
        if found.is_file():
            yield _Source(found, folder)
        folders = [found.parent] if found.stem == "__init__" else [found] if found.is_dir() else []
    if item == "*":
        yield from (_Source(path, folder) for place in folders for path in Path(place).glob("*.py"))
