"""Pictures that show whether a registration is right: contours on the photograph, and how the pose
was found."""

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from ..geometry import rotation_error
from ..geometry.framing import clipped
from ..matching import ViewDescriber
from ..registration import Hypothesis, Registrar, Registration
from ..registration.confidence import two_decimals
from ..registration.photograph import Photograph, as_photograph
from ..terms import crop_photographs, photograph_field
from ..utils.arrays import Bytes
from ..utils.checks import as_numbers
from ..utils.likes import BoxLike, ImageLike
from ..utils.precision import full_precision
from .contours import Drawn, draw_close_up, draw_window
from .encoding import to_uint8
from .words import pose_in_words

# px of the photograph's longer side in the picture
LEAST = 960
MOST = 1600
NARROWEST = 720  # px of width that the caption needs
TILE = 180  # least side of a small picture in px
GAP = 10  # px between pictures
PAPER = (255, 255, 255)
INK = (30, 30, 30)
FAINT = (100, 100, 100)
VERDICT_COLOURS = {
    "reliable": (20, 125, 65),
    "reliable axis": (20, 105, 125),
    "unsure": (185, 105, 0),
    "no match": (190, 40, 40),
}
AXIS_RADII = 1.3  # from the middle to the end of an axis, in radii of the object
LEGEND = "Green: outline of the mesh at this pose. Orange: its inner edges. White: the box."


def contour_overlay(
    registrar: Registrar,
    result: Registration | Hypothesis,
    image: ImageLike | Photograph,
    box: BoxLike | None = None,
    *,
    copies: Sequence[Registration] = (),
) -> Bytes:
    """The photograph with the mesh's outline (green), its inner edges (orange) at the pose, and the
    box (white).

    Args:
        registrar, result: the result of this registrar, or one of its hypotheses; it is drawn with
            its ``projection``.
        image, box: the photograph, as the registrar takes it: a (1 or 3, H, W) tensor, an array or
            a path; (4,) px. A prepared :class:`.Photograph` has its box.
        copies: further objects that :func:`.detect` found in it; they are drawn too.

    Returns:
        (H, W, 3) uint8 RGB.

    Example:
        >>> import curvireg_torch as cr
        >>> scene = cr.synthetic.demo_scene()
        >>> views = cr.sample_views(azimuth_step=60, elevations=[20])
        >>> bank = cr.ViewBank.build(scene.mesh, views, image_size=64, progress=False)
        >>> registrar = cr.Registrar(bank)
        >>> result = registrar([scene.image], [scene.box], scene.camera_matrix)[0]
        >>> contour_overlay(registrar, result, scene.image, scene.box).shape
        (720, 960, 3)
    """
    item = _shown(image, box)
    return _whole(registrar, result, item, copies, 1.0)


def _whole(
    registrar: Registrar,
    result: Registration | Hypothesis,
    item: Photograph,
    copies: Sequence[Registration],
    scale: float,
) -> Bytes:
    """The photograph, resized by ``scale``, with the object and its copies."""
    target = registrar.of_mesh(getattr(result, "mesh_index", 0))
    axis = _axis_ends(registrar, result) if isinstance(result, Registration) else None
    drawn = Drawn(target.describer, result.projection, item.box.tolist(), axis)
    H, W = item.size
    objects = [*drawn_copies(registrar, copies), drawn]
    return draw_window(item.image, (0, 0, W, H), scale, objects)


def _shown(image: ImageLike | Photograph, box: BoxLike | None) -> Photograph:
    """The photograph that is drawn, with the part of the box that it shows."""
    if isinstance(image, Photograph):
        return replace(image, box=clipped(image.box.float(), image.size))
    return as_photograph(image, None if box is None else as_numbers(box, "box"))


def _axis_ends(registrar: Registrar, result: Registration) -> Tensor | None:
    """(2, 3) start and end, in the model's frame, of the arrow that shows the axis where it alone
    is reliable; else None."""
    target = registrar.of_mesh(result.mesh_index)
    axis = target.round_axis
    if axis is None or result.verdict != "reliable axis":
        return None
    reach = AXIS_RADII * target.describer.radius * axis.direction
    return torch.stack([axis.point - reach, axis.point + reach])


def drawn_copies(registrar: Registrar, copies: Sequence[Registration]) -> list[Drawn]:
    """What is drawn of further objects that :func:`.detect` found."""
    return [
        Drawn(
            registrar.of_mesh(copy.mesh_index).describer,
            copy.projection,
            copy.detection.box.tolist(),
        )
        for copy in copies
        if copy.detection is not None
    ]


def views_sheet(
    describer: ViewDescriber,
    views: Sequence[tuple[tuple[Tensor, Tensor], Tensor, Sequence[float] | None, str]],
) -> Bytes:
    """(H, W, 3) uint8 RGB: photographs side by side; of each pose and camera matrix, pixels, box or
    None, caption."""
    columns = math.ceil(math.sqrt(len(views)))
    side = MOST // columns - GAP
    tiles = []
    for projection, image, box, caption in views:
        H, W = image.shape[-2:]
        drawn = Drawn(describer, projection, box)
        tiles.append((caption, draw_window(image, (0, 0, W, H), side / max(H, W), [drawn])))
    height = max(picture.shape[0] for _, picture in tiles)
    sheet = Image.new("RGB", (MOST, -(-len(views) // columns) * (height + 32 + GAP)), PAPER)
    _paste_tiles(sheet, tiles, (0, 0), columns, (side, height), 16)
    return np.asarray(sheet).copy()


def _paste_tiles(
    sheet: Image.Image,
    tiles: Sequence[tuple[str, Bytes]],
    corner: tuple[int, int],
    columns: int,
    size: tuple[int, int],
    line: int,
) -> None:
    """Paste pictures into a grid of cells of ``size`` (W, H), each with its caption below, ``line``
    px high."""
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(line)
    W, H = size
    for k, (caption, picture) in enumerate(tiles):
        x = corner[0] + k % columns * (W + GAP)
        y = corner[1] + k // columns * (H + 2 * line + GAP)
        h, w = picture.shape[:2]
        sheet.paste(Image.fromarray(picture), (x + (W - w) // 2, y + (H - h) // 2))
        draw.text((x, y + H + line // 3), caption, INK, font)


@torch.no_grad()
@full_precision()
def side_pictures(
    registrar: Registrar,
    result: Registration | Hypothesis,
    image: ImageLike | Photograph,
    box: BoxLike | None = None,
) -> dict[str, Bytes]:
    """(S, S, 3) uint8 RGB of "photograph", "photograph field", "pose", "view field"; see
    :func:`contour_overlay`.

    Example:
        >>> import curvireg_torch as cr
        >>> scene = cr.synthetic.demo_scene()
        >>> views = cr.sample_views(azimuth_step=60, elevations=[20])
        >>> bank = cr.ViewBank.build(scene.mesh, views, image_size=64, progress=False)
        >>> registrar = cr.Registrar(bank)
        >>> result = registrar([scene.image], [scene.box], scene.camera_matrix)[0]
        >>> sorted(side_pictures(registrar, result, scene.image, scene.box))
        ['photograph', 'photograph field', 'pose', 'view field']
    """
    item = _shown(image, box)
    settings = registrar.bank.settings
    crop = crop_photographs(
        [item.image], item.box[None], size=settings.image_size, margin=settings.margin
    )
    field = photograph_field(registrar.matcher.field, crop.to(registrar.bank.device))[0]
    at = result.allocentric_rotation[None], torch.tensor([result.distance])
    shaded = registrar.describer.shaded(*at)[0]  # grey, or grey and RGB
    return {
        "photograph": to_uint8(crop[0]),
        "photograph field": _field_picture(field[0]),
        "pose": to_uint8(shaded[-3:]),
        "view field": _field_picture(registrar.describer.fields(*at)[0]),
    }


def _field_picture(field: Tensor) -> Bytes:
    """Strong edges are dark, on white."""
    length = field.float().norm(dim=0, keepdim=True)
    return to_uint8(1.0 - (length / length.max().clamp(min=1e-12)).sqrt())


@torch.no_grad()
@full_precision()
def registration_sheet(
    registrar: Registrar,
    result: Registration,
    image: ImageLike | Photograph,
    box: BoxLike | None = None,
    *,
    note: str = "",
    copies: Sequence[Registration] = (),
) -> Bytes:
    """The photograph with the pose's contours and a caption; below it a close-up, the compared
    fields and the rivals.

    The photograph's longer side becomes 960 to 1600 px. Below a rival stand its rotation from the
    answer and its probability. Arguments as for :func:`contour_overlay`; ``note`` ends the legend.

    Returns:
        (H', W', 3) uint8 RGB.

    Example:
        >>> import curvireg_torch as cr
        >>> scene = cr.synthetic.demo_scene()
        >>> views = cr.sample_views(azimuth_step=60, elevations=[20])
        >>> bank = cr.ViewBank.build(scene.mesh, views, image_size=64, progress=False)
        >>> registrar = cr.Registrar(bank)
        >>> result = registrar([scene.image], [scene.box], scene.camera_matrix)[0]
        >>> registration_sheet(registrar, result, scene.image, scene.box).shape[1]
        960
    """
    item = _shown(image, box)
    if _axis_ends(registrar, result) is not None:
        note = f"Blue: the axis, which is certain; the turn about it is not. {note}"
    H, W = item.size
    scale = min(max(LEAST, H, W), MOST) / max(H, W)
    photograph = _whole(registrar, result, item, copies, scale)
    registrar = registrar.of_mesh(result.mesh_index)
    if copies:
        note = f"{1 + len(copies)} objects; words and small pictures: the best one. {note}"
    height = photograph.shape[0]
    width = max(NARROWEST, photograph.shape[1])
    count = 3 + len(result.hypotheses)
    rows = -(-count // (width // TILE))
    columns = -(-count // rows)
    side = (width - GAP) // columns - GAP
    text = max(15, width // 60)
    line = max(12, side // 13)
    top = height + 4 * text + GAP
    step = side + 2 * line + GAP
    sheet = Image.new("RGB", (width, top + rows * step), PAPER)
    sheet.paste(Image.fromarray(photograph), ((width - photograph.shape[1]) // 2, 0))
    _draw_caption(ImageDraw.Draw(sheet), registrar, result, (GAP, height + text // 2), text, note)
    _paste_tiles(
        sheet,
        _small_pictures(registrar, result, item, side),
        (GAP, top),
        columns,
        (side, side),
        line,
    )
    return np.asarray(sheet).copy()


def _draw_caption(
    draw: ImageDraw.ImageDraw,
    registrar: Registrar,
    result: Registration,
    corner: tuple[int, int],
    size: int,
    note: str,
) -> None:
    """Verdict and pose in words, and the meaning of the colours."""
    x, y = corner
    word = result.verdict
    font = ImageFont.load_default(size)
    badge = word
    if result.confidence is not None:
        badge += f": confidence {two_decimals(result.confidence)}"
    right = x + draw.textlength(badge, font) + size
    draw.rounded_rectangle((x, y, right, y + 1.6 * size), 0.5 * size, VERDICT_COLOURS[word])
    draw.text((x + size / 2, y + 0.8 * size), badge, PAPER, font, anchor="lm")
    mesh = registrar.bank.mesh
    front = None if result.prior is None else result.prior.front
    pose = pose_in_words(result.rotation, up=mesh.up, front=front)
    if result.translation is not None:
        pose += f", {float(f'{result.distance:.3g}'):g} {mesh.unit or 'units'} away"
    if registrar.others:
        pose = f"mesh {result.mesh_index}, {pose}"
    room = draw.im.size[0] - right - 1.5 * size
    font = ImageFont.load_default(min(size, size * room / draw.textlength(pose, font)))
    draw.text((right + size / 2, y + 0.8 * size), pose, INK, font, anchor="lm")
    draw.text((x, y + 2 * size), f"{LEGEND} {note}", FAINT, ImageFont.load_default(0.75 * size))


def _small_pictures(
    registrar: Registrar, result: Registration, item: Photograph, side: int
) -> list[tuple[str, Bytes]]:
    """Captions and pictures, at most ``side`` px wide and high."""
    box = item.box.tolist()
    objects = [Drawn(registrar.describer, pose.projection) for pose in result.hypotheses]
    close_ups = [draw_close_up(item.image, box, side, [each]) for each in objects]
    sides = side_pictures(registrar, result, item)
    names = "photograph field", "view field", "pose"
    captions = "edges of the photograph", "edges of the mesh", "mesh at this pose"
    found = [cv2.resize(sides[name], (side, side), interpolation=cv2.INTER_CUBIC) for name in names]
    rivals = [(_rival(result, k), close_ups[k]) for k in range(1, len(close_ups))]
    return [("close-up", close_ups[0]), *zip(captions, found, strict=True), *rivals]


def _rival(result: Registration, index: int) -> str:
    angle = float(rotation_error(result.hypotheses[index].rotation, result.rotation))
    text = f"rival: {angle:.0f}° away"
    return f"{text} ({two_decimals(result.probabilities[index])})" if result.probabilities else text
