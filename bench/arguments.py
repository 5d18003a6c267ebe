"""What is promised, as a program gets it: functions whose arguments are held against their
annotations, for a caller may be untyped, and instruments that are refused behind their with block.
(pydantic's `validate_call` has no schema for 14 of them, and refuses NumPy's whole numbers.)
"""

from __future__ import annotations

import inspect
import sys
import types
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache, partial, wraps
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from bench.config import ArgumentError, ConfigError, short
from instruments.errors import LimitError
from textfiles.bounds import NUMBER, WHOLE

Kind = TypeVar("Kind")
NUMBERS = {float: NUMBER, int: WHOLE}
PLAIN: Mapping[Any, str] = {
    **{kind: bounds.what for kind, bounds in NUMBERS.items()},
    bool: "True or False",
    str: "a text",
    Path: "a path",
    types.NoneType: "None",
    Callable: "a function",
    Mapping: "a mapping",
}


def guarded(thing: Any, package: str) -> Any:
    """A function of ``package`` that refuses arguments of a wrong kind; anything else as it is."""
    if not inspect.isfunction(thing):
        return thing
    shape, hints = inspect.signature(thing), cache(lambda: _hints(thing))

    @wraps(thing)
    def call(*args: Any, **more: Any) -> Any:
        __tracebackhide__ = True  # pytest then shows where it was called
        given = shape.bind_partial(*args, **more)
        for name, value in given.arguments.items():
            if isinstance(value, Iterator):  # is looked at, and used then
                given.arguments[name] = value = tuple(value)
            many = shape.parameters[name].kind is inspect.Parameter.VAR_POSITIONAL
            hint = hints().get(name, Any)  # a method's self has none
            if wrong := [one for one in (value if many else [value]) if not fits(one, hint)]:
                said = short(" ".join(repr(wrong[0]).split()))
                raise ConfigError.plain(f"{name} is {said}, not {words(hint)}")
        return thing(*given.args, **given.kwargs)

    call.__module__, call.__qualname__ = package, thing.__name__  # where pickle finds it
    return call


_guarded = cache(lambda function: guarded(function, function.__module__))


class GuardedProxy:
    """An open thing as a program gets it: its methods as `guarded`, a wrong value a ConfigError
    too. `_given` raises LimitError once it was given back.
    """

    def __init__(self, of: Any, given: Callable[[], object]) -> None:
        vars(self).update(_of=of, _given=given)

    def __setattr__(self, name: str, value: object) -> None:
        setattr(self._of, name, value)

    __class__ = property(lambda self: type(self._of))

    def __getattr__(self, name: str) -> Any:
        method = inspect.getattr_static(type(self._of), name, None)
        if inspect.isfunction(method) and name not in getattr(self._of, "__dict__", ()):
            return partial(self._ask, method)
        self._given()
        return getattr(self._of, name)

    def _ask(self, method: Callable[..., Any], *args: Any, **more: Any) -> Any:
        self._given()
        try:
            return _guarded(method)(self._of, *args, **more)
        except ValueError as error:
            if type(error) is not ValueError:  # one with a name of its own is promised as it is
                raise
            raise ArgumentError.plain(str(error)) from error


def bare(thing: Kind) -> Kind:
    """What a `GuardedProxy` stands for, anything else as it is: since Python 3.12 a check for a
    protocol does not look through one. Raises LimitError for what was given back.
    """
    if type(thing) is not GuardedProxy:
        return thing
    own = vars(thing)
    own["_given"]()
    return cast(Kind, own["_of"])


@contextmanager
def lent(of: Kind, who: str) -> Iterator[Kind]:
    """``of`` until the block ends, and never after."""
    left = list[bool]()

    def given() -> None:
        if left:
            hint = "Open it again, and use it inside of its with block."
            raise LimitError(who, "it was closed at the end of its with block", hint=hint)

    try:
        yield cast(Kind, GuardedProxy(of, given))
    finally:
        left.append(True)


def _hints(function: Any) -> dict[str, Any]:
    """Annotations of its parameters; what is for type checkers alone is left out."""
    found = dict[str, Any]()
    for name, one in function.__annotations__.items():
        if name != "return":
            with suppress(Exception):  # of another's detector, too
                own = types.SimpleNamespace(__annotations__={name: one})
                found |= get_type_hints(own, vars(sys.modules[function.__module__]))
    return found


def fits(value: Any, hint: Any) -> bool:
    """Whether ``value`` is of the kind ``hint``: NaN and inf are no numbers, a text no list."""
    made, parts = _made_of(hint), get_args(hint)
    if isinstance(value, str | Path) and "\0" in str(value):  # no file, name or address has it
        return False
    if made is Union:
        return any(fits(value, one) for one in parts)
    if made is Literal:
        return isinstance(value, Hashable) and value in parts
    if made is Callable:
        return callable(value)
    if made in (tuple, Iterable):
        if not isinstance(value, Collection) or isinstance(value, str | bytes | Mapping):
            return False
        of = parts if made is tuple else parts[:1] * len(value)
        return len(of) == len(value) and all(map(fits, value, of))
    if made in NUMBERS:
        return NUMBERS[made].has(value)
    if getattr(made, "_is_protocol", False):  # which a class has not, but what it makes
        return not isinstance(value, type) and all(
            callable(getattr(value, name, None)) for name in _methods(made)
        )
    return made is Any or not isinstance(made, type) or isinstance(value, made)


def words(hint: Any) -> str:
    """What fits ``hint``, for a message."""
    made, parts = _made_of(hint), get_args(hint)
    if made in (Union, Literal):
        return " or ".join(dict.fromkeys(map(words if made is Union else repr, parts)))
    if made is tuple:
        return f"({', '.join(map(words, parts))})"
    if made is Iterable:
        return f"a list, of {words(parts[0])} each"
    name = getattr(made, "__name__", "thing")
    return PLAIN.get(made, f"a{'n' if name[0] in 'AEIOU' else ''} {name}")


def _made_of(hint: Any) -> Any:
    """`Union`, `Literal`, `tuple` of so many, `Iterable` for any list; else its class."""
    origin = get_origin(hint) or hint
    if named := getattr(origin, "__value__", None):  # an alias, as NDArray is since NumPy 2.5
        origin = get_origin(named) or named
    if origin is types.UnionType:
        return Union
    if origin is tuple:
        return Iterable if get_args(hint)[-1:] == (...,) else tuple
    if get_args(hint) and getattr(origin, "__module__", "") in ("builtins", "collections.abc"):
        kinds = (one for one in (Mapping, Iterable) if issubclass(origin, one))
        return next(kinds, origin)
    return origin


def _methods(protocol: type) -> Iterator[str]:
    """Of a protocol; to look at its properties might ask an instrument."""
    for base in protocol.__mro__[:-1]:
        yield from (n for n, one in vars(base).items() if n[0] != "_" and inspect.isfunction(one))
