"""The overlay video: contours at the pose, captions, and what is written where OpenCV cannot
encode."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from curvireg_torch.data import Video
from curvireg_torch.errors import InvalidInputError, LostObjectError, OutputError
from curvireg_torch.registration import FailedRegistration
from curvireg_torch.visualization import OverlayVideo
from curvireg_torch.visualization.video import annotated_frame, caption
from tests._support import CAMERA, refused, scene, truck_registrar

LOST = FailedRegistration(LostObjectError("not near the start"))


@pytest.fixture(scope="module")
def registered():
    image, box, _ = scene(0)
    return image, truck_registrar()([image], box[None], CAMERA)[0]


def test_overlay_video_has_every_frame(registered, tmp_path):
    image, result = registered
    odd = image[:, :179, :239]
    with OverlayVideo(tmp_path / "overlay.mp4", truck_registrar(), fps=7.0) as video:
        video.add(None, LOST)  # nothing is known of the size yet
        for one, found in ((odd, result), (odd, LOST), (None, LOST), (image, result)):
            video.add(one, found)
    assert [path.name for path in tmp_path.iterdir()] == ["overlay.mp4"]
    written = Video(tmp_path / "overlay.mp4")
    frames = [frame.permute(1, 2, 0).numpy().astype(int) for _, frame in written]
    assert (written.fps, [f.shape for f in frames]) == (7.0, [(178, 238, 3)] * 5)
    assert frames.pop(0)[np.s_[40:]].max() < 30  # black, as large as the first that was read
    body = np.s_[40:]
    expected = annotated_frame(truck_registrar(), odd, result)[:178, :238].astype(int)
    assert np.abs(frames[0] - expected)[body].mean() < 12  # the codec is lossy
    assert np.abs(frames[0] - frames[1])[body].max() > 60  # contours, and none
    assert frames[2][body].max() < 30
    assert np.abs(frames[3] - frames[0]).mean() < 12


@pytest.mark.parametrize(("fps", "written"), [(119.907, 119.91), (23.976, 23.976)])
def test_overlay_video_keeps_rates_that_mpeg_4_can_tell(registered, tmp_path, fps, written):
    with OverlayVideo(tmp_path / "overlay.mp4", truck_registrar(), fps=fps) as video:
        video.add(*registered)
    assert Video(tmp_path / "overlay.mp4").fps == pytest.approx(written, abs=1e-4)


def test_caption_says_how_sure_the_pose_is(registered):
    for confidence, expected in ((0.95, "reliable"), (0.6, "unsure"), (0.4, "no match")):
        result = replace(registered[1], probabilities=(confidence,))
        assert caption(result)[0] == f"{expected}, confidence {confidence:.2f}"
    assert (caption(LOST)[0], caption(FailedRegistration(InvalidInputError("no")))[0]) == (
        "lost",
        "failed",
    )


def test_overlay_video_warns_without_an_encoder(registered, tmp_path, monkeypatch):
    image, result = registered
    monkeypatch.setattr(cv2.VideoWriter, "fourcc", lambda *_: 0x20202020)
    with OverlayVideo(tmp_path / "overlay.mp4", truck_registrar(), fps=7.0) as video:
        with pytest.warns(UserWarning, match="no MPEG-4 encoder"):
            video.add(image, result)
        video.add(image, LOST)
    assert list(tmp_path.iterdir()) == []


def test_overlay_video_that_cannot_be_finished_is_an_error(registered, tmp_path):
    """The disk is full: OpenCV says nothing."""
    image, found = registered
    resource = pytest.importorskip("resource", reason="no limits of files on this system")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def write():
        with OverlayVideo(tmp_path / "overlay.mp4", truck_registrar(), fps=7.0) as video:
            for _ in range(3):
                video.add(image, found)
            resource.setrlimit(resource.RLIMIT_FSIZE, (20, before[1]))

    try:
        with refused(r"overlay\.mp4: cannot be written whole \(0 of 3", OutputError):
            write()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(
    ("error", "raised"), [(KeyboardInterrupt, OutputError), (RuntimeError, RuntimeError)]
)
def test_which_error_of_a_video_counts_more(registered, tmp_path, monkeypatch, error, raised):
    image, found = registered
    monkeypatch.setattr("curvireg_torch.visualization.video._frames_in", lambda _: 0)

    def write():
        with OverlayVideo(tmp_path / "overlay.mp4", truck_registrar(), fps=7.0) as video:
            video.add(image, found)
            raise error

    with pytest.raises(raised):
        write()
