"""The base class of the modules that mirror a function."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from ..errors import InvalidInputError
from ..utils.aliases import Fields
from ..utils.checks import check_positive


def _positive_option(name: str) -> property:
    """Attribute ``name`` of a module: a fixed value, or one by its logarithm, the parameter
    ``log_NAME``, so that any optimiser step keeps it positive. (torch's parametrizations do the
    same, but their modules cannot be pickled.)"""

    def value(self: "FunctionModule") -> Any:
        # an attribute, for copies of nn.DataParallel have no parameters
        log = getattr(self, f"log_{name}", None)
        return self._fixed[name] if log is None else log.exp()

    def assign(self: "FunctionModule", new: Any) -> None:
        log = self._parameters.get(f"log_{name}")
        if log is None:
            self._fixed[name] = new
            return
        values = torch.as_tensor(new, dtype=torch.float64)
        if not ((values > 0) & values.isfinite()).all():
            raise InvalidInputError(f"{name}: expected finite values > 0, got {new!r:.40}")
        with torch.no_grad():
            log.copy_(values.log())

    return property(value, assign)


class FunctionModule(nn.Module):
    """Module twin of a function of images,
    ``class Twin(FunctionModule, function=f, learnable=("sigma",))``. It holds the function's
    options, refuses what the function refuses, and has its documentation. A twin writes its
    constructor only as a signature, for type checkers and editors; the flag ``learnable`` makes
    options positive parameters."""

    _function: ClassVar[Callable[..., Tensor]]
    _learnable: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(
        cls, *, function: Callable[..., Tensor] | None = None, learnable: tuple[str, ...] = ()
    ):
        super().__init_subclass__()
        for name in learnable:
            setattr(cls, name, _positive_option(name))
        cls._learnable = (*cls._learnable, *learnable)
        if function is None:
            return
        cls._function = staticmethod(function)
        declared = cls.__init__
        defaults = {
            name: p.default
            for name, p in inspect.signature(declared).parameters.items()
            if name != "self"
        }

        @functools.wraps(declared)
        def construct(self: "FunctionModule", **options: Any) -> None:
            declared(self, **options)  # refuses other names
            values = {**defaults, **options}
            FunctionModule.__init__(
                self, learnable if values.pop("learnable", False) else (), **values
            )
            # The function refuses wrong options: it is called with no image, or with as many as
            # there are cameras.
            camera = values.get("camera_matrix")
            count = len(camera) if isinstance(camera, Tensor) and camera.ndim == 3 else 0
            function(torch.zeros(count, 1, 1, 1, device=getattr(camera, "device", "cpu")), **values)

        cls.__init__ = construct  # type: ignore[method-assign, assignment]
        if cls.__doc__:
            flag = (
                f" ``learnable`` makes {' and '.join(learnable)} positive parameters."
                if learnable
                else ""
            )
            usage = f"The constructor takes the options, a call the images.{flag}"
            cls.__doc__ = f"{cls.__doc__} {usage}\n\n{inspect.getdoc(function)}"

    def __init__(self, learnable: tuple[str, ...] = (), **options: Any) -> None:
        super().__init__()
        self._names = tuple(options)
        self._fixed: Fields = {}
        for name, value in options.items():
            if name in learnable:
                start = value if isinstance(value, Tensor) else check_positive(value, name)
                log = torch.as_tensor(start, dtype=torch.float64).log().float()
                self.register_parameter(f"log_{name}", nn.Parameter(log))
            elif name == "camera_matrix":
                # not all devices have float64
                camera = value.float() if isinstance(value, Tensor) else None
                self.register_buffer(name, camera, persistent=False)
            else:
                setattr(self, name, tuple(value) if isinstance(value, list) else value)

    @property
    def options(self) -> Fields:
        """The present values, as keyword arguments of the function."""
        return {name: getattr(self, name) for name in self._names}

    def forward(self, image: Tensor) -> Tensor:
        return self._function(image, **self.options)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move a camera matrix between devices, but keep float32: ``.half()`` would round it."""
        camera = self._buffers.get("camera_matrix")
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        moved = self._buffers.get("camera_matrix")
        if camera is not None and moved is not None:
            # of a meta tensor there are no values to move
            kept = moved if camera.is_meta else camera
            self._buffers["camera_matrix"] = kept.to(moved.device, camera.dtype)
        return self

    def extra_repr(self) -> str:
        options = self.options
        texts = []
        if "camera_matrix" in options:
            texts.append("orthographic" if options.pop("camera_matrix") is None else "perspective")
        texts += [f"{name}={_short_text(value)}" for name, value in options.items()]
        return ", ".join(texts)


def _short_text(value: Any) -> str:
    """An option: of tensors, the value of a scalar that can be read, or the shape."""
    if not isinstance(value, Tensor):
        return repr(value)
    is_number = value.ndim == 0 and not value.is_meta
    return str(round(float(value.detach()), 6)) if is_number else f"<{tuple(value.shape)}>"


class DepthModule(FunctionModule):
    """Module twin of a function of depth images and masks."""

    def forward(self, depth: Tensor, mask: Tensor | None = None) -> Tensor:
        return self._function(depth, mask, **self.options)
