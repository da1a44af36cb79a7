"""What a policy finds in place of modules and functions that it may name, and may not use."""

from __future__ import annotations

from typing import NoReturn

from sortie.policies.verification.pure import is_seeded
from sortie.policies.verification.watch import reach, stop


class Outside:
    """A module that is not pure, or a part of it. It may be imported and named; every use is recorded and raises."""

    def __init__(self, path: str) -> None:
        self._path = path

    def __getattr__(self, name: str) -> Outside:
        if name.startswith("__"):
            raise AttributeError(name)
        return Outside(f"{self._path}.{name}")

    def __mro_entries__(self, _: object) -> NoReturn:
        self._used()

    def _used(self, *_: object, **__: object) -> NoReturn:
        if is_seeded(self._path):
            stop(f"draws from {self._path}")
        reach(self._path)


_OPERATORS = (
    "call iter next reversed len bool getitem setitem delitem contains eq ne lt le gt ge add radd sub rsub mul rmul matmul "
    "rmatmul truediv rtruediv floordiv rfloordiv mod rmod divmod rdivmod pow rpow lshift rlshift rshift rrshift and rand or "
    "ror xor rxor neg pos abs invert float int index complex round trunc floor ceil bytes str repr format hash enter exit "
    "instancecheck subclasscheck await aiter anext fspath"
)
for _operator in _OPERATORS.split():
    setattr(Outside, f"__{_operator}__", Outside._used)


class Unknown(Outside):
    """A function that no search can follow."""

    def _used(self, *_: object, **__: object) -> NoReturn:
        stop(self._path)


for _operator in _OPERATORS.split():
    setattr(Unknown, f"__{_operator}__", Unknown._used)
