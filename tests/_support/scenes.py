"""Small scenes shared by tests."""

from dataclasses import replace
from functools import cache

import cv2
import pytest
import torch

from curvireg_torch import Registrar, ViewBank, camera_matrix, sample_views
from curvireg_torch.geometry import (
    rotation_error,
    rotation_from_axis_angle,
    rotation_from_viewpoint,
    transform,
)
from curvireg_torch.mesh import mesh_centre, mesh_radius
from curvireg_torch.pipeline import PRESETS
from curvireg_torch.registration.result import Detection
from curvireg_torch.synthetic import example_mesh, random_pose, synthesize_photograph
from tests._support.numbers import double, seeded

SIZE = (180, 240)
CAMERA = camera_matrix(260.0, 260.0, 119.5, 89.5)


@cache
def truck_bank():
    return bank_around(example_mesh(), 15, [0, 15, 30, 45, 60], pipeline=PRESETS["classical"])


@cache
def learned_registrar():
    """A registrar of the truck with the default pipeline, whose results have a confidence, and
    exact boxes."""
    return exact_registrar(bank_around(example_mesh(), 15, [0, 20, 40, 60]))


@cache
def scene(seed):
    """image (3, H, W), box (4,), true T_cam_from_model (4, 4)."""
    generator = seeded(seed)
    T = random_pose(example_mesh(), CAMERA, SIZE, generator, elevations=(5.0, 50.0))
    image, box = synthesize_photograph(example_mesh(), T, CAMERA, SIZE, generator)
    return image, box, T


def first_scenes(count):
    """Images, boxes (count, 4) and true poses."""
    images, boxes, poses = zip(*map(scene, range(count)), strict=True)
    return list(images), torch.stack(boxes), poses


def seen_from(mesh, azimuth, elevation, radii):
    """(4, 4) pose of a mesh whose centre lies straight ahead, so many of its radii away."""
    R = rotation_from_viewpoint(azimuth, elevation, 0.0).double()
    ahead = double([0.0, 0.0, radii * mesh_radius(mesh)])
    return transform(R, ahead - R @ mesh_centre(mesh))


def photograph_of(mesh, azimuth, elevation, seed, radii=5.0):
    """(3, H, W) that shows a mesh so, its box (4,) and the true ``T_cam_from_model``."""
    T = seen_from(mesh, azimuth, elevation, radii)
    return (*synthesize_photograph(mesh, T, CAMERA, SIZE, seeded(seed)), T)


def bank_of(mesh, views=None, **options):
    return ViewBank.build(mesh, views, progress=False, **options)


def bank_around(mesh, step, elevations, **options):
    """A bank of views at 96 px: azimuths in steps, and these elevations."""
    views = sample_views(azimuth_step=step, elevations=elevations)
    return bank_of(mesh, views, **{"image_size": 96} | options)


def answer_of(registrar, image, box, camera=CAMERA, **options):
    """The result of one photograph, by default of ``CAMERA``."""
    return registrar([image], box[None], camera, **options)[0]


def answer_to(seed, registrar):
    """The result of a scene."""
    image, box, _ = scene(seed)
    return answer_of(registrar, image, box)


@cache
def truck_answer():
    """The result of the first scene by :func:`truck_registrar`."""
    return answer_to(0, truck_registrar())


@cache
def learned_answer():
    """The result of the first scene by :func:`learned_registrar`."""
    return answer_to(0, learned_registrar())


def degrees_off(result, T):
    """How far the rotation of a result is from that of a pose."""
    return rotation_error(result.rotation, T[:3, :3])


def errors(result, T):
    """Degrees, and the error of the position as a fraction of the distance."""
    return pose_errors(result.transform, T)


def pose_errors(found, T):
    """:func:`errors` of a pose (4, 4)."""
    away = float((found - T)[:3, 3].norm() / T[:3, 3].norm())
    return float(rotation_error(found[:3, :3], T[:3, :3])), away


def check_near(found, T, degrees, share):
    """A pose (4, 4) is that near to the true one."""
    turned, moved = pose_errors(found, T)
    assert turned < degrees
    assert moved < share


def check_agreement(one, other):
    """Two results of one photograph agree to .05 degrees, and .01 of confidence."""
    assert rotation_error(one.rotation, other.rotation) < 0.05
    assert other.confidence == pytest.approx(one.confidence, abs=0.01)
    assert other.verdict == one.verdict


@cache
def frame(number):
    """A photograph of a sequence, its box and pose: 4 degrees about a vertical axis and 2 % nearer
    from frame to frame."""
    T = scene(0)[2]
    if number > 0:
        T = frame(number - 1)[2].clone()
        T[:3, :3] = rotation_from_axis_angle(double([0.0, 0.07, 0.0])) @ T[:3, :3]
        T[:3, 3] *= 0.98
    return (*synthesize_photograph(example_mesh(), T, CAMERA, SIZE, seeded(9)), T)


def sequence(count):
    return [frame(number) for number in range(count)]


def unrefined(bank, **changes):
    """The bank's pipeline without search and contour fit: results are views of the bank."""
    return replace(bank.pipeline, search=False, contours=False, **changes)


def exact_registrar(bank, **options):
    """A registrar of exact boxes, in which photographs are registered once."""
    return Registrar(bank, pipeline=replace(bank.pipeline, box_jitter=0.0), **options)


@cache
def truck_registrar(**changes):
    """A registrar of the truck in exact boxes, with changed fields of its pipeline."""
    pipeline = replace(truck_bank().pipeline, **{"box_jitter": 0.0} | changes)
    return Registrar(truck_bank(), pipeline=pipeline)


def bytes_bgr(image):
    """A photograph (3, H, W) in [0, 1] as OpenCV has it."""
    pixels = (image.permute(1, 2, 0).flip(-1) * 255).round().byte()
    return pixels.contiguous().numpy()


def write_photo(path, image):
    """Write a photograph (3, H, W) in [0, 1]."""
    assert cv2.imwrite(str(path), bytes_bgr(image))


def write_video(path, images, rate=10.0):
    """Write photographs (3, 180, 240) in [0, 1] as a video."""
    path.parent.mkdir(parents=True, exist_ok=True)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate, SIZE[::-1])
    for image in images:
        video.write(bytes_bgr(image))
    video.release()
    return path


def found_in(registrar, image, boxes):
    """What detection might find in a photograph: an object in each box."""
    boxes = torch.stack(boxes).double()
    results = registrar([image] * len(boxes), boxes)
    scores = torch.linspace(0.9, 0.5, len(boxes)).tolist()
    found = zip(results, boxes, scores, strict=True)
    return [
        replace(result, detection=Detection(box, score, 7.0, boxes, torch.ones(len(boxes))))
        for result, box, score in found
    ]


def two_trucks():
    """A photograph (3, H, 2 W) of two trucks side by side, and their boxes."""
    left, first, _ = scene(0)
    right, second, _ = scene(1)
    shift = torch.tensor([SIZE[1], 0.0, SIZE[1], 0.0])
    return torch.cat([left, right], dim=2), [first, second + shift]
