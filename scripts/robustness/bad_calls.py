"""Calls of the Python interface with one mistake each, for bad_inputs.py; files are those of bad_files.py."""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
import trimesh

import curvireg_torch as cr
from curvireg_torch.data import BOPDataset, Pascal3DPlus, WebCollection, read_photo
from curvireg_torch.geometry.pose_prior import PosePrior
from curvireg_torch.pipeline import Pipeline
from curvireg_torch.registration import Registration

__all__ = ["CALLS"]

K = torch.tensor([[260.0, 0, 119.5], [0, 260, 89.5], [0, 0, 1]])
BOX = torch.tensor([[30.0, 25, 210, 160]])
NEAR = PosePrior(distance=(1.0, 2.0))
PHOTO = torch.linspace(0, 1, 3 * 180 * 240).view(1, 3, 180, 240)


@cache
def registrar() -> cr.Registrar:
    return cr.Registrar(cr.ViewBank.load("bank.safetensors"))


def register(images: Any = PHOTO, boxes: Any = BOX, cameras: Any = K, **options: Any) -> Any:
    """The pose of one photograph; raises the error of a failed registration."""
    (result,) = registrar()(images, boxes, cameras, **options)
    return result if isinstance(result, Registration) else result.rotation


def box(*values: float) -> torch.Tensor:
    return torch.tensor([values])


CALLS: list[tuple[str, Callable[[], object], list[str]]] = [
    ("load_mesh of a missing file", lambda: cr.load_mesh("lost.ply"), ["lost.ply"]),
    ("load_mesh of an empty file", lambda: cr.load_mesh("empty.obj"), ["empty.obj"]),
    ("load_mesh with another unit", lambda: cr.load_mesh("truck.ply", unit="inch"), ["unit"]),
    ("Registrar of None", lambda: cr.Registrar(None), ["mesh"]),
    ("Registrar of a picture", lambda: cr.Registrar("photo.png"), ["photo.png"]),
    ("Registrar of an empty mesh", lambda: cr.Registrar(trimesh.Trimesh()), ["mesh"]),
    ("Registrar on no device", lambda: cr.Registrar("truck.ply", device="gpu"), ["device"]),
    ("Registrar of no mesh", lambda: cr.Registrar([]), ["mesh"]),
    ("ViewBank.load of a mesh", lambda: cr.ViewBank.load("truck.ply"), ["truck.ply"]),
    ("ViewBank.load of other tensors", lambda: cr.ViewBank.load("other.safetensors"), ["other.safetensors"]),
    ("read_photo of a text", lambda: read_photo("text.jpg"), ["text.jpg"]),
    ("Pipeline.read of a text", lambda: Pipeline.read("broken.json"), ["broken.json"]),
    ("camera_matrix with a focal length of 0", lambda: cr.camera_matrix(0.0, 1.0, 0.0, 0.0), ["fx"]),
    ("camera_matrix of NaN", lambda: cr.camera_matrix(math.nan, 1.0, 0.0, 0.0), ["camera"]),
    ("sample_views with a step of 0", lambda: cr.sample_views(azimuth_step=0), ["azimuth_step"]),
    ("PosePrior of reversed distances", lambda: PosePrior(distance=(2.0, 1.0)), ["distance"]),
    ("PosePrior of NaN", lambda: PosePrior(azimuth=(math.nan, 1.0)), ["azimuth"]),
    ("register one photograph without a list", lambda: register(PHOTO[0]), ["image"]),
    ("register two channels", lambda: register(PHOTO[:, :2]), ["image"]),
    ("register NaN", lambda: register(PHOTO * math.nan), ["image"]),
    ("register 0 to 255 as floats", lambda: register(255 * PHOTO), ["255"]),
    ("register a word", lambda: register(["lost.png"]), ["lost.png"]),
    ("register int64", lambda: register((255 * PHOTO).long()), ["uint8"]),
    ("register an array of objects", lambda: register([np.array([None])]), ["image"]),
    ("register one colour", lambda: register(torch.full_like(PHOTO, 0.3)), ["colour"]),
    ("register a box as XYWH", lambda: register(boxes=box(200, 25, 40, 150)), ["box"]),
    ("register a box outside", lambda: register(boxes=box(900, 900, 950, 950)), ["box"]),
    ("register a box of NaN", lambda: register(boxes=box(math.nan, 25, 210, 160)), ["box"]),
    ("register a box of 1 px", lambda: register(boxes=box(30, 25, 31, 26)), ["px"]),
    ("register a box of 1e9 px", lambda: register(boxes=box(-1e9, -1e9, 1e9, 1e9)), ["box"]),
    ("register two boxes of one photograph", lambda: register(boxes=BOX.repeat(2, 1)), ["boxes"]),
    ("register a box of three numbers", lambda: register(boxes=BOX[:, :3]), ["boxes"]),
    ("register with words as boxes", lambda: register(boxes="box"), ["boxes"]),
    ("register with a camera of 4 numbers", lambda: register(cameras=[260, 260, 119.5, 89.5]), ["camera"]),
    ("register with a camera of zeros", lambda: register(cameras=torch.zeros(3, 3)), ["camera"]),
    ("register with a camera of NaN", lambda: register(cameras=K * math.nan), ["camera"]),
    ("register with a mirrored camera", lambda: register(cameras=K * torch.tensor([-1.0, 1, 1])), ["camera"]),
    ("register with a distance and no camera", lambda: register(cameras=None, prior=NEAR), ["camera"]),
    ("refine from a pose that is not rigid", lambda: registrar().refine(PHOTO, K, 2 * torch.eye(4)[None]), ["pose"]),
    ("refine from behind the camera", lambda: registrar().refine(PHOTO, K, torch.eye(4)[None])[0].rotation, ["camera"]),
    ("Pascal3DPlus of an empty folder", lambda: Pascal3DPlus("empty"), ["empty"]),
    ("BOPDataset of an empty folder", lambda: BOPDataset("empty"), ["empty"]),
    ("WebCollection of a missing folder", lambda: WebCollection("lost"), ["lost"]),
    ("rotation_from_viewpoint of NaN", lambda: cr.rotation_error(torch.zeros(2, 2), torch.eye(3)), ["3"]),
    ("HOG of one channel", lambda: cr.hog(PHOTO[:, :1]), ["2"]),
]  # fmt: skip
"""Name, call, and what the message must name."""
