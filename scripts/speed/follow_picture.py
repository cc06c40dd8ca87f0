"""Draw docs/images/follow.webp: a generated video of the example truck, followed; a post passes in front of it.

python scripts/speed/follow_picture.py
"""

import tempfile
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch.io import Video
from curvireg_torch.matching import cached_bank
from curvireg_torch.registration import Follower
from curvireg_torch.synthetic import example_mesh, procedural_background, random_pose, synthesize_photograph
from curvireg_torch.visualization import OverlayVideo
from curvireg_torch.visualization.encoding import shrink
from scripts._shared import REPOSITORY
from scripts.benchmark.sequences import camera_path

PICTURE = REPOSITORY / "docs" / "images" / "follow.webp"
SIZE, FRAMES, FPS = (480, 640), 40, 10.0
SEED = 3
POST, WIDTH = 40, 400  # of the post, and of the drawn picture, px


def video(seed: int) -> tuple[list[Tensor], Tensor, Tensor]:
    """The (3, H, W) frames, the box in the first one, and the camera matrix."""
    mesh, K = example_mesh(), cr.camera_matrix(840.0, 840.0, 319.5, 239.5, dtype=torch.float64)
    T = random_pose(mesh, K, SIZE, torch.Generator().manual_seed(seed), elevations=(15.0, 40.0), fill=(0.6, 0.7))
    rng = np.random.default_rng(seed)
    centre = torch.from_numpy(mesh.bounds.mean(axis=0))
    start = (T[:3, :3] @ centre + T[:3, 3]).numpy()
    background = procedural_background(SIZE, torch.Generator().manual_seed(seed))
    frames, boxes = [], []
    for number, (R, place) in enumerate(camera_path(T[:3, :3].numpy(), start, K.numpy(), FRAMES, rng)):
        T[:3, :3] = torch.from_numpy(R)
        T[:3, 3] = torch.from_numpy(place) - T[:3, :3] @ centre
        generator = torch.Generator().manual_seed(seed)  # the same light and texture in every frame
        frame, box = synthesize_photograph(mesh, T, K, SIZE, generator, background=background)
        left = SIZE[1] * (number + 1) // FRAMES - POST
        frame[:, :, max(left, 0) : left + POST] = torch.tensor([0.35, 0.3, 0.25])[:, None, None]
        frames.append(frame)
        boxes.append(box)
    return frames, boxes[0], K


def main() -> None:
    frames, box, K = video(SEED)
    pipeline = cr.Pipeline().with_pose_prior("upright")
    registrar = cr.Registrar(cached_bank(example_mesh(), pipeline=pipeline, progress=False), pipeline=pipeline)
    follow = Follower(registrar, K)
    with tempfile.TemporaryDirectory() as folder:
        with OverlayVideo(Path(folder, "overlay.mp4"), registrar, fps=FPS) as overlay:
            for number, frame in enumerate(frames):
                result = follow(frame, None if number else box)
                overlay.add(frame, result)
                print(number, result.confidence if result.ok else result.error)
        pictures = [Image.fromarray(shrink(frame.permute(1, 2, 0).numpy(), WIDTH)) for _, frame in Video(overlay.path)]
    first, *others = pictures
    first.save(PICTURE, save_all=True, append_images=others, duration=round(1000 / FPS), loop=0, quality=70)


if __name__ == "__main__":
    main()
