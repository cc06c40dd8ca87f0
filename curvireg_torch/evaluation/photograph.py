"""One photograph in one line: :func:`register`."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass, fields
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from torch import Tensor

from ..data import load_camera, read_photo
from ..errors import InvalidInputError
from ..geometry import camera_matrix
from ..geometry.pose_prior import PosePrior
from ..matching import ViewBank
from ..mesh import load_mesh
from ..pipeline import Pipeline
from ..registration import FailedRegistration, Registrar, Registration
from ..registration.result import result_document
from ..visualization import contour_overlay, plots
from ..visualization.encoding import jpeg, shrink
from .result_files import write_result
from .runner import box_of_result, image_item_of, register_image

__all__ = ["RegisteredPhotograph", "register"]

THUMBNAIL_SIDE = 480  # pixels of the overlay's longer side in a notebook


@dataclass(frozen=True, repr=False)
class RegisteredPhotograph(Registration):
    """A :class:`Registration` that knows its photograph, and so can be drawn and saved.

    Attributes:
        registrar: of the mesh.
        image, box: the photograph, without distortion; (4,) x0, y0, x1, y1 in px in which the object was found.
    """

    registrar: Registrar = None  # type: ignore[assignment]  # fields of the base class have defaults
    image: Tensor = None  # type: ignore[assignment]
    box: Tensor = None  # type: ignore[assignment]

    def overlay(self) -> np.ndarray:
        """(H, W, 3) uint8 RGB: the photograph with the contours of the mesh at the pose, and the box."""
        return contour_overlay(self.registrar, self, self.image, self.box)

    def plot(self) -> Any:
        """The overlay as a ``matplotlib.figure.Figure``; needs matplotlib."""
        return plots.picture(self.overlay())

    def save(self, folder: str | PathLike[str]) -> None:
        """Write ``result.json``, ``overlay.png`` and ``pose.glb`` as ``curvireg register --out`` does."""
        document = result_document(self, self.registrar, {"bank": 0.0, "register": 0.0})
        document["inputs"] = {"box": self.box.tolist()}
        write_result(Path(folder), document, self.registrar, self, self.image, self.box)

    def _repr_html_(self) -> str:
        """For notebooks: the overlay above the pose."""
        data = base64.b64encode(jpeg(shrink(self.overlay(), THUMBNAIL_SIDE), 85)).decode()
        return f'<img alt="contours on the photograph" src="data:image/jpeg;base64,{data}">{super()._repr_html_()}'


def register(
    image: Any,
    mesh: Any,
    *,
    box: Any = None,
    camera: Any = None,
    mask: Any = None,
    prior: PosePrior | None = None,
    unit: str = "m",
    up: str | None = None,
    pipeline: Pipeline | None = None,
    progress: bool = True,
) -> RegisteredPhotograph:
    """Find the pose of a mesh in one photograph.

    Args:
        image: a path, a PIL image, an (H, W) or (H, W, 3) array, or a (1 or 3, H, W) tensor.
        mesh: a mesh or a bank, or the path of one, see :class:`Registrar`; or a registrar, which is faster for several
            photographs.
        box: x0, y0, x1, y1 in px; without box and mask the object is searched for.
        camera: fx, fy, cx, cy in px, a (3, 3) camera matrix, a :class:`Camera`, or the path of a calibration file;
            "exif" takes the focal length of the photograph's file. None: the rotation is estimated alone.
        mask: (H, W) of the object, white, or its path.
        prior: limits on the pose.
        unit, up: of a mesh file, see :func:`load_mesh`.
        pipeline: the default is that of :class:`Registrar`.
        progress: show progress while the views of a mesh are rendered, the first time.

    Raises:
        CurviregError: an input that cannot be used, or a photograph that shows nothing to register.

    Example:
        >>> import curvireg_torch as cr
        >>> scene = cr.synthetic.demo_scene()
        >>> views = cr.sample_views(azimuth_step=20, elevations=[10, 30])
        >>> bank = cr.ViewBank.build(scene.mesh, views, image_size=64, progress=False)
        >>> result = cr.register(scene.image, bank, box=scene.box, camera=scene.camera_matrix)
        >>> result.quaternion.shape, result.overlay().shape
        (torch.Size([4]), (720, 960, 3))
    """
    if isinstance(image, Image.Image):
        image = np.array(image.convert("RGB"))
    photo = read_photo(image) if isinstance(image, str | PathLike) else None
    image = image if photo is None else photo.image
    if isinstance(camera, str | PathLike):
        if camera == "exif":
            camera = None if photo is None else photo.guessed_camera_matrix()
            if camera is None:
                raise InvalidInputError("camera: no focal length in EXIF; give fx, fy, cx, cy, or a calibration file")
        else:
            camera = load_camera(camera)
    elif isinstance(camera, Sequence) and len(camera) == 4:
        camera = camera_matrix(*camera)
    registrar = mesh
    if not isinstance(mesh, Registrar):
        if isinstance(mesh, str | PathLike):
            path = Path(mesh)
            mesh = ViewBank.load(path) if path.suffix == ".safetensors" else load_mesh(path, unit=unit, up=up)
        registrar = Registrar(mesh, pipeline=pipeline, progress=progress)
    item = image_item_of(image, box, camera, prior, mask, name="")
    result = register_image(registrar, image, box, camera, prior, mask)[0]
    if isinstance(result, FailedRegistration):
        raise result.error.with_subject("")
    found = box_of_result(result, registrar, item, given=box is not None or mask is not None).double()
    values = {field.name: getattr(result, field.name) for field in fields(Registration)}
    box = found if result.corrected_box is None else result.corrected_box
    return RegisteredPhotograph(**values, registrar=registrar, image=item.image, box=box)
