"""To read a mesh file, or to refuse it, takes time in proportion to its size, whatever fills it."""

import pytest

from curvireg_torch.errors import MeshError
from tests._support.doubling import check_linear
from tests._support.refusals import refused
from tests.formats.meshes.test_obj import BOX
from tests.formats.meshes.test_ply import FACES, header, rows

PLY, PLY_END = (header(comments="HERE") + rows([""] * 4) + FACES).split("HERE")
HOSTILE = {
    "obj blanks": (f"{BOX}f", " " * 20, "\n"),
    "obj blanks behind": (f"{BOX}f 1 2 3", " " * 20, "x\n"),
    "obj slashes": (f"{BOX}f 1", "/" * 20, " 2 3\n"),
    "obj blank lines": (BOX, " \n" * 10, ""),
    "obj materials": (BOX, "usemtl m{}\nf 1 2 3\n", ""),
    "obj groups": (BOX, "g m{}\nf 1 2 3\n", ""),
    "obj libraries": (BOX, "mtllib m{}.mtl\n", ""),
    "obj continued": (BOX, "f 1 2 3 \\\n", ""),
    "obj comments": (BOX, "#" * 20, ""),
    "obj minus": (f"{BOX}f ", "-" * 20, "\n"),
    "ply comments": (PLY, "comment\n", PLY_END),
    "ply blanks": (f"{PLY}comment", " " * 20, f"x\n{PLY_END}"),
    "ply textures": (PLY, "comment TextureFile a.png\n", PLY_END),
    "stl vertex": ("solid a\nvertex", " " * 20, "\n"),
    "stl blanks": ("solid a\n", " " * 20, "x\n"),
    "stl lines": ("solid a\n", " \n" * 20, ""),
    "stl end": ("solid a\n", "end " * 10, "\n"),
}
"""What precedes and follows the part that comes again and again."""


@pytest.mark.parametrize("name", HOSTILE)
def test_time_grows_with_the_size(write, load, name):
    """Of four times the size, at most nine times the time; quadratic readers take sixteen times as
    long."""
    suffix = name[:3]
    head, part, end = HOSTILE[name]

    def written(n):
        parts = (part.format(k % 4000) for k in range(n))
        return write(f"a.{suffix}", f"{head}{''.join(parts)}{end}")

    if suffix == "stl":
        with refused("cut short", MeshError):
            load(written(100))
    check_linear(load, written, 1_000 if name == "obj libraries" else 5_000)  # each is looked for
