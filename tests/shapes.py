"""jaxtyping's checks of shapes in a third of their time, with its own messages.

jaxtyping 0.3 writes two functions for each function of the package as it is imported, checks the parameters before a
call and again behind it, and binds them to the signature for its messages. Here the checks of a function are written
when it is first called, parameters are checked once, and what fails is checked again by jaxtyping itself, which has the
last word. Hints in quotes are looked up when jaxtyping does: a class that comes later in its module is ``Any``.
"""

import functools
import inspect
from collections.abc import Callable
from types import FunctionType
from typing import Any, NamedTuple

import jaxtyping
from jaxtyping import _array_types, _decorator
from jaxtyping._storage import get_shape_memo, pop_shape_memo, push_shape_memo

_inner: Any = _decorator
_arrays: Any = _array_types
_original = _inner.jaxtyped
_is_array = _arrays._MetaAbstractArray.__instancecheck__
_config = jaxtyping.config
_missing = object()
_written: dict[Any, tuple[Callable, Callable | None]] = {}


def speed_up() -> None:
    """For the whole process, before it imports the package."""
    _inner.jaxtyped = jaxtyping.jaxtyped = _jaxtyped
    _arrays._MetaAbstractArray.__instancecheck__ = _fits


def _jaxtyped(fn: Any = _missing, *, typechecker: Any = _missing) -> Any:
    if isinstance(fn, FunctionType) and callable(typechecker) and not getattr(fn, "__no_type_check__", False):
        return _checked(fn, typechecker)
    if inspect.isclass(fn) and getattr(fn.__init__, "__globals__", None) is globals():
        return fn  # the initializer that a class inherits is checked already
    given = {"fn": fn, "typechecker": typechecker}
    return _original(**{name: value for name, value in given.items() if value is not _missing})


def _checked(fn: FunctionType, typechecker: Callable) -> Callable:
    signature = _hinted(fn) if any(_is_quoted(hint) for hint in fn.__annotations__.values()) else None
    checks: tuple[Callable, Callable | None] | None = None

    def by_jaxtyping(call: Callable) -> Callable:
        told: Any = functools.wraps(fn)(lambda *args, **kwargs: call(*args, **kwargs))
        told.__signature__ = signature or inspect.signature(fn)
        return _original(told, typechecker=typechecker)

    @functools.wraps(fn)
    def checked(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        nonlocal checks
        if _config.jaxtyping_disable:
            return fn(*args, **kwargs)
        if checks is None:
            checks = _checks(fn, signature or inspect.signature(fn), typechecker)
        parameters, result = checks
        push_shape_memo({})
        try:
            if _fails(parameters, *args, **kwargs):
                return by_jaxtyping(fn)(*args, **kwargs)
            out = fn(*args, **kwargs)
            if result is not None and _fails(result, out):
                return by_jaxtyping(lambda *args, **kwargs: out)(*args, **kwargs)  # without running again
            return out
        finally:
            pop_shape_memo()

    return checked


def _is_quoted(hint: Any) -> bool:
    return not isinstance(hint, type) and ("'" in repr(hint) or isinstance(hint, str))


def _hinted(fn: FunctionType) -> inspect.Signature:
    signature = inspect.signature(fn)
    found = functools.partial(_inner._destring_annotation, ns=fn.__globals__)
    parameters = [one.replace(annotation=found(one.annotation)) for one in signature.parameters.values()]
    return signature.replace(parameters=parameters, return_annotation=found(signature.return_annotation))


def _fails(check: Callable, /, *args: Any, **kwargs: Any) -> bool:
    try:
        check(*args, **kwargs)
    except Exception:
        return True
    return False


def _checks(fn: FunctionType, signature: inspect.Signature, typechecker: Callable) -> tuple[Callable, Callable | None]:
    """Of the parameters and of the result; a function within another one is made anew at each call."""
    key = fn.__code__, fn.__module__, typechecker, *fn.__annotations__.items()
    try:
        if key not in _written:
            _written[key] = _write(fn, signature, typechecker)
    except TypeError:  # an annotation without a hash
        return _write(fn, signature, typechecker)
    return _written[key]


def _write(fn: FunctionType, signature: inspect.Signature, typechecker: Callable) -> tuple[Callable, Callable | None]:
    taken = signature.replace(return_annotation=Any)
    write = _inner._make_fn_with_signature
    parameters = typechecker(write(fn.__name__, fn.__qualname__, fn.__module__, taken, output=False))
    returned = signature.return_annotation
    if returned is inspect.Signature.empty or returned is Any:
        return parameters, None
    try:
        return parameters, _result(returned, typechecker)
    except TypeError:  # an annotation without a hash
        return parameters, _result.__wrapped__(returned, typechecker)


@functools.cache
def _result(hint: Any, typechecker: Callable) -> Callable:
    """Many functions return the same."""
    signature = inspect.Signature(return_annotation=hint)
    result, name = _inner._make_fn_with_signature("returns", "returns", __name__, signature, output=True)
    result = typechecker(result)
    return lambda out: result(**{name: out})


class _Plain(NamedTuple):
    """Axes that are numbers, names, or anything (None), and the types of elements that jaxtyping has let through."""

    kind: type
    axes: tuple[int | str | None, ...]
    dtypes: set[Any]


_plans: dict[Any, _Plain | None] = {}


def _fits(hint: Any, value: Any) -> bool:
    """What is alike in most calls; jaxtyping is asked for all else, and before anything is refused."""
    if hint not in _plans:
        _plans[hint] = _plan(hint)
    plan = _plans[hint]
    if plan is None or not isinstance(value, plan.kind) or len(value.shape) != len(plan.axes):
        return _is_array(hint, value)
    if value.dtype not in plan.dtypes:
        fits = _is_array(hint, value)
        if fits:
            plan.dtypes.add(value.dtype)
        return fits
    sizes = get_shape_memo()[0]
    named: dict[str, int] = {}
    for axis, size in zip(plan.axes, value.shape, strict=True):
        if axis is None or axis == size:
            continue
        known = sizes.get(axis, named.setdefault(axis, size)) if isinstance(axis, str) else None
        if known != size:
            return _is_array(hint, value)
    sizes.update(named)
    return True


def _plan(hint: Any) -> _Plain | None:
    axes = [_axis(one) for one in getattr(hint, "dims", (...,))]
    if ... in axes or hint.array_type is Any or hint._skip_instancecheck:
        return None
    return _Plain(hint.array_type, tuple(axes), set())


def _axis(axis: Any) -> Any:
    if axis is _arrays._anonymous_dim:
        return None
    if isinstance(axis, _arrays._FixedDim) and not axis.broadcastable:
        return axis.size
    if isinstance(axis, _arrays._NamedDim) and not axis.broadcastable and not axis.treepath:
        return axis.name
    return ...
