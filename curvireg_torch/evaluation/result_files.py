"""The files of one result: ``result.json``, ``overlay.png``, ``pose.glb`` and ``pose.yaml``."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from ..errors import InvalidInputError
from ..registration import Registrar, Registration
from ..registration.result import SCHEMA
from ..utils.choices import UNITS
from ..utils.files import write_file
from ..utils.threads import map_on_threads
from ..visualization import pose_glb, registration_sheet
from ..visualization.encoding import png
from ..visualization.overlay import views_sheet
from ..visualization.pose_glb import scene_glb
from .store import to_json

RigPicture = tuple[Tensor, Tensor, Tensor, str] | None
"""Pixels, camera matrix, ``T_cam_from_world`` and name of a photograph of a rig; None if it could not be read."""

MAX_GLB_FACES = 300_000  # of the largest mesh that is written: viewers are slow with files above 30 MB


def write_result(
    out: Path, document: dict[str, Any], registrar: Registrar, result: Registration, image: Any, box: Any
) -> None:
    """Write the files of a result into the folder ``out``; ``document`` is the content of ``result.json``.

    The picture and the scene are drawn beside each other, on threads. The other arguments are those of
    :func:`curvireg_torch.visualization.registration_sheet`. :class:`OutputError` if a file cannot be written.
    """
    mesh = registrar.of_model(result.model).bank.mesh
    note = "Distortion of the lens removed." if _distorts(document.get("camera")) else ""
    _write(
        out,
        document,
        lambda: png(registration_sheet(registrar, result, image, box, note=note)),
        lambda: pose_glb(mesh, *result.projection, image) if len(mesh.faces) <= MAX_GLB_FACES else None,
    )


def write_views(
    out: Path, document: dict[str, Any], registrar: Registrar, result: Registration, photographs: Sequence[RigPicture]
) -> None:
    """Write the files of one pose in several photographs."""
    few = len(registrar.of_model(result.model).bank.mesh.faces) <= MAX_GLB_FACES
    _write(
        out,
        document,
        lambda: views_picture(registrar, result, photographs),
        lambda: views_glb(registrar, result, photographs) if few else None,
    )


def views_picture(registrar: Registrar, result: Registration, photographs: Sequence[RigPicture]) -> bytes:
    """``overlay.png`` of several photographs: those that could be read, with the contours at the pose."""
    shown = []
    for one, view in zip(photographs, result.views, strict=True):
        if one is not None:
            image, K, _, name = one
            score = "" if view.edge_support is None else f"edge support {view.edge_support:.2f}"
            box = None if view.box is None else view.box.tolist()
            shown.append(((view.T_cam_from_model, K), image, box, f"{name}: {view.failure or score}"))
    return png(views_sheet(registrar.of_model(result.model).describer.renderer, shown))


def views_glb(registrar: Registrar, result: Registration, photographs: Sequence[RigPicture]) -> bytes:
    """``pose.glb`` of several photographs, with the cameras of those that count."""
    assert result.transform is not None
    pairs = zip(photographs, result.views, strict=True)
    cameras = [(one[2], one[1], one[0]) for one, view in pairs if one is not None and not view.failure]
    return scene_glb(registrar.of_model(result.model).bank.mesh, result.transform, cameras)


def _write(
    out: Path, document: dict[str, Any], overlay: Callable[[], bytes], scene: Callable[[], bytes | None]
) -> None:
    _remove(out)
    write_file(out / "result.json", to_json(document).encode())  # first: no failure to draw it loses the result

    def attempt(file: tuple[str, Callable[[], bytes | None]]) -> Exception | None:
        try:
            if (content := file[1]()) is not None:
                write_file(out / file[0], content)
        except Exception as error:  # it must not cost the other file
            return error
        return None

    for error in map_on_threads(attempt, [("overlay.png", overlay), ("pose.glb", scene)]):
        if error is not None:
            raise error


def write_pose_stamped(path: Path, document: dict[str, Any]) -> None:
    """Write the pose as a ``geometry_msgs/PoseStamped`` of ROS in YAML: metres, in the camera's optical frame."""
    if document["translation"] is None:
        raise InvalidInputError("--format ros: a pose without translation; give a camera")
    w, x, y, z = document["quaternion"]
    metres = [v * UNITS[document["unit"] or "m"] for v in document["translation"]]
    lines = ["header:", "  stamp: {sec: 0, nanosec: 0}"]
    lines += [f"  frame_id: {'world' if isinstance(document['views'], list) else 'camera_optical_frame'}", "pose:"]
    lines += ["  position: {x: %.9g, y: %.9g, z: %.9g}" % tuple(metres)]  # noqa: UP031
    lines += ["  orientation: {x: %.12g, y: %.12g, z: %.12g, w: %.12g}" % (x, y, z, w)]  # noqa: UP031
    write_file(path, ("\n".join(lines) + "\n").encode())


def _distorts(camera: dict[str, Any] | None) -> bool:
    return camera is not None and (camera["model"] == "fisheye" or any(camera["distortion"]))


def write_lost(out: Path, message: str) -> None:
    """Write the ``result.json`` of a refinement that lost the object."""
    _remove(out)
    write_file(out / "result.json", to_json({"schema": SCHEMA, "status": "lost", "message": message}).encode())


def _remove(out: Path) -> None:
    """Remove an older result: none of its files may stay beside those of a new one."""
    for name in ("result.json", "pose.glb", "overlay.png", "pose.yaml"):
        (out / name).unlink(missing_ok=True)
