"""The base class of the modules that mirror a function."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from ..utils.checks import check_positive


class Positive(nn.Module):
    """Parametrization of a positive parameter by its logarithm, so that any optimiser step keeps it
    positive."""

    def forward(self, log: Tensor) -> Tensor:
        return log.exp()

    def right_inverse(self, value: Tensor) -> Tensor:
        return value.log()


class FunctionModule(nn.Module):
    """Module twin of a function of images,
    ``class Twin(FunctionModule, function=f, learnable=("sigma",))``. It holds the function's
    options, refuses what the function refuses, and has its documentation. A twin writes its
    constructor only as a signature, for type checkers and editors; the flag ``learnable`` makes
    options positive parameters."""

    _function: ClassVar[Callable[..., Tensor]]

    def __init_subclass__(
        cls, *, function: Callable[..., Tensor] | None = None, learnable: tuple[str, ...] = ()
    ):
        super().__init_subclass__()
        # a further subclass, such as those that torch derives for parametrized modules
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
        for name, value in options.items():
            if name in learnable:
                self.register_parameter(
                    name, nn.Parameter(torch.tensor(check_positive(value, name)))
                )
                parametrize.register_parametrization(self, name, Positive())
            elif name == "camera_matrix":
                self.register_buffer(name, value, persistent=False)
            else:
                setattr(self, name, tuple(value) if isinstance(value, list) else value)

    @property
    def options(self) -> dict[str, Any]:
        """The present values, as keyword arguments of the function."""
        return {name: getattr(self, name) for name in self._names}

    def forward(self, image: Tensor) -> Tensor:
        return self._function(image, **self.options)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move a camera matrix between devices, but keep its dtype: ``.half()`` would round it."""
        camera = self._buffers.get("camera_matrix")
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        moved = self._buffers.get("camera_matrix")
        if camera is not None and moved is not None:
            self._buffers["camera_matrix"] = camera.to(moved.device)
        return self

    def extra_repr(self) -> str:
        options = self.options
        texts = []
        if "camera_matrix" in options:
            texts.append("orthographic" if options.pop("camera_matrix") is None else "perspective")
        for name, value in options.items():
            texts.append(
                f"{name}={round(float(value.detach()), 6) if isinstance(value, Tensor) else value!r}"  # noqa: E501
            )
        return ", ".join(texts)


class DepthModule(FunctionModule):
    """Module twin of a function of depth images and masks."""

    def forward(self, depth: Tensor, mask: Tensor | None = None) -> Tensor:
        return self._function(depth, mask, **self.options)
