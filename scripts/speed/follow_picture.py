"""Draw docs/images/follow.webp: a generated video of the example truck, followed; a post passes in front of it.

python scripts/speed/follow_picture.py
"""

import math
import tempfile
from pathlib import Path

import torch
import trimesh
from PIL import Image
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch.data import Video
from curvireg_torch.matching import cached_bank
from curvireg_torch.mesh import mesh_centre, mesh_radius
from curvireg_torch.registration import Follower
from curvireg_torch.synthetic import example_mesh, synthesize_photograph
from curvireg_torch.visualization import OverlayVideo
from curvireg_torch.visualization.encoding import shrink
from scripts._shared import REPOSITORY

PICTURE = REPOSITORY / "docs" / "images" / "follow.webp"
SIZE, FRAMES, FPS = (480, 640), 40, 10.0
SEED = 3
POST, WIDTH = 40, 400  # of the post, and of the drawn picture, px


def poses(mesh: trimesh.Trimesh) -> Tensor:
    """(FRAMES, 4, 4) of a camera that swings around the truck, comes closer and leaves again."""
    centre, radius = mesh_centre(mesh), mesh_radius(mesh)
    time = torch.linspace(0.0, 2.0 * math.pi, FRAMES, dtype=torch.float64)
    R = cr.rotation_from_viewpoint(320.0 + 35.0 * time.sin(), 24.0 + 8.0 * (2.0 * time).sin(), 4.0 * (3.0 * time).sin())
    distance = radius * (7.0 - 1.2 * time.cos())
    centred = torch.stack([0.15 * radius * time.sin(), 0.1 * radius * (2.0 * time).cos(), distance], dim=-1)
    T = torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)
    T[:, :3, :3], T[:, :3, 3] = R, centred - R @ centre
    return T


def video(seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """The (FRAMES, 3, H, W) frames, the box in the first one, and the camera matrix."""
    K = cr.camera_matrix(840.0, 840.0, 319.5, 239.5, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    frames, boxes = synthesize_photograph(example_mesh(painted=True), poses(example_mesh()), K, SIZE, generator)
    for number, frame in enumerate(frames):
        left = SIZE[1] * (number + 1) // FRAMES - POST
        frame[:, :, max(left, 0) : left + POST] = torch.tensor([0.35, 0.3, 0.25])[:, None, None]
    return frames, boxes[0], K


def main() -> None:
    truths, (frames, box, K) = poses(example_mesh()), video(SEED)
    pipeline = cr.Pipeline().with_pose_prior("upright")
    registrar = cr.Registrar(cached_bank(example_mesh(), pipeline=pipeline, progress=False), pipeline=pipeline)
    follow = Follower(registrar, K)
    with tempfile.TemporaryDirectory() as folder:
        with OverlayVideo(Path(folder, "overlay.mp4"), registrar, fps=FPS) as overlay:
            for number, frame in enumerate(frames):
                result = follow(frame, None if number else box)
                overlay.add(frame, result)
                if result.ok:
                    error = float(cr.rotation_error(result.rotation, truths[number, :3, :3]))
                    print(f"{number}: {error:.1f} degrees off, confidence {result.confidence:.2f}")
                else:
                    print(f"{number}: {result.error}")
        pictures = [Image.fromarray(shrink(frame.permute(1, 2, 0).numpy(), WIDTH)) for _, frame in Video(overlay.path)]
    first, *others = pictures
    first.save(PICTURE, save_all=True, append_images=others, duration=round(1000 / FPS), loop=0, quality=70)


if __name__ == "__main__":
    main()
