import cv2
import numpy as np
import pytest
import torch

from curvireg_torch.data import Video
from curvireg_torch.data.frames import FrameReader
from curvireg_torch.errors import CurviregWarning, ImageError
from tests._support import refused
from tests._support.spies import spied


@pytest.fixture(scope="module")
def five(tmp_path_factory):
    """A video whose frame k is red of brightness 40 k."""
    file = tmp_path_factory.mktemp("videos") / "five.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 12.5, (64, 48))
    for k in range(5):
        writer.write(np.full((48, 64, 3), (0, 0, 40 * k), np.uint8))
    writer.release()
    return file


def test_video_yields_rgb_frames_and_their_numbers(five):
    video = Video(five)
    assert (video.fps, video.count) == (12.5, 5)
    frames = dict(video)
    assert list(frames) == [0, 1, 2, 3, 4]
    assert len(list(video)) == 5  # again from the start
    for k, image in frames.items():
        assert (tuple(image.shape), image.dtype) == ((3, 48, 64), torch.uint8)
        assert abs(float(image[0].float().mean()) - 40 * k) < 4
        assert image[1:].float().mean() < 4
    some = dict(Video(five, every=2))
    assert list(some) == [0, 2, 4]
    assert torch.equal(some[4], frames[4])
    with refused("every"):
        Video(five, every=0)


def test_a_video_that_was_cut_says_so(five, tmp_path):
    data = five.read_bytes()
    cut = tmp_path / "cut.avi"
    cut.write_bytes(
        data[: data.index(b"idx1") - 2 * (data.index(b"idx1") - data.index(b"movi")) // 5]
    )
    with pytest.warns(CurviregWarning, match=r"cut\.avi: ends after 3 of 5 frames"):
        assert len(list(Video(cut))) == 3


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".webm", ".mov"])
def test_video_reads_other_containers(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    code = "VP80" if suffix == ".webm" else "mp4v"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 25.0, (64, 48))
    if not writer.isOpened():
        pytest.skip(f"OpenCV writes no {suffix} here")
    for _ in range(3):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    assert len(list(Video(path))) == 3


def test_video_refuses_playlists_other_files_and_too_many_pixels(five, tmp_path, monkeypatch):
    stream = "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n{}\n#EXT-X-ENDLIST\n"
    for text in ("ffconcat version 1.0\nfile {}\n", stream):
        five.with_name("list.mp4").write_text(text.format(five.name))
        with refused("not a video", ImageError):
            Video(five.with_name("list.mp4"))
    (tmp_path / "no.mp4").write_bytes(b"\0\0\0\x20ftypisom" + bytes(500))
    with refused(r"no\.mp4: not a video", ImageError):
        Video(tmp_path / "no.mp4")
    with refused("cannot be read", ImageError):
        Video(tmp_path / "nothing.mp4")
    monkeypatch.setattr("curvireg_torch.data.images.MAX_IMAGE_PIXELS", 64 * 48 - 1)
    with refused("not a video", ImageError):
        Video(five)


def test_frame_reader_decodes_once_for_numbers_in_order(five, monkeypatch):
    frames = dict(Video(five))
    opened = spied(monkeypatch, Video, "__iter__")
    reader = FrameReader(five)
    for number in (0, 1, 3, 4):
        assert torch.equal(reader.read(number), frames[number])
    assert len(opened) == 1
    for _ in range(2):
        assert torch.equal(reader.read(0), frames[0]), "again from the start"
    assert len(opened) == 3
    assert torch.equal(FrameReader(five, every=3).read(3), frames[3])
    with refused(r"five\.avi: no frame 9", ImageError):
        reader.read(9)
    assert Video(five, every=2).numbers() == [0, 2, 4]


def test_frames_after_a_damaged_one_are_not_decoded_again(five, monkeypatch):
    opened = []

    def damaged(video):
        opened.append(video.path)
        yield 0, torch.zeros(3, 4, 4)
        raise ImageError("frame 1 cannot be read")

    monkeypatch.setattr(Video, "__iter__", damaged)
    reader = FrameReader(five)
    for number in (1, 2, 3):
        with refused("frame 1 cannot", ImageError):
            reader.read(number)
    assert len(opened) == 1
