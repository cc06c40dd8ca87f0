"""Photographs given as files: each is decoded once, and few are in memory at a time."""

import weakref

import cv2
import torch

from curvireg_torch.registration import inputs
from tests._support.scenes import CAMERA, scene, truck_registrar


def test_photographs_are_decoded_once_and_not_kept(tmp_path, monkeypatch):
    read_photo, alive, most, decoded = inputs.read_photo, weakref.WeakSet(), [0], []

    def counted(path, **options):
        photo = read_photo(path, **options)
        alive.add(photo.image)
        decoded.append(path)
        most[0] = max(most[0], len(alive))
        return photo

    monkeypatch.setattr(inputs, "read_photo", counted)
    scenes = [scene(seed) for seed in range(6)]
    paths = [tmp_path / f"{seed}.png" for seed in range(6)]
    for path, (image, *_) in zip(paths, scenes, strict=True):
        pixels = (255.0 * image).round().byte().permute(1, 2, 0).numpy()
        assert cv2.imwrite(str(path), pixels[..., ::-1])
    registrar = truck_registrar(search=False, contours=False)
    results = registrar(paths, torch.stack([box for _, box, _ in scenes]), CAMERA)
    assert all(result.ok for result in results)
    assert decoded.count(paths[0]) == 1
    assert len(decoded) == len(paths)
    assert most[0] <= torch.get_num_threads() + 1
    assert len(alive) <= 1
