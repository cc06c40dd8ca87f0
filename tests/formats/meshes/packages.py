"""3MF files, which are zip archives, URDF and USD files."""

import zipfile

import trimesh

BOX = trimesh.creation.box((30.0, 20.0, 10.0))
SMALL = trimesh.creation.box((3.0, 2.0, 1.0))
ITEM = '<item objectid="1"/>'


def model(resources, items=ITEM, unit='unit="inch"'):
    """The text of a model in a 3MF file."""
    namespace = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
    text = (
        f'<?xml version="1.0"?><model {unit} xmlns="{namespace}" xmlns:m="materials" '
        f'xmlns:p="production">'
    )
    return f"{text}<resources>{resources}</resources><build>{items}</build></model>"


def threemf(path, *content, more=None, **how):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", model(*content, **how))
        for name, content in (more or {}).items():
            archive.writestr(name, content)
    return path


def solid(number, attributes="", triangle="", shape=BOX):
    vertices = "".join('<vertex x="{:g}" y="{:g}" z="{:g}"/>'.format(*v) for v in shape.vertices)
    faces = "".join(
        f'<triangle v1="{a}" v2="{b}" v3="{c}" {triangle if k < 6 else ""}/>'
        for k, (a, b, c) in enumerate(shape.faces)
    )
    mesh = f"<mesh><vertices>{vertices}</vertices><triangles>{faces}</triangles></mesh>"
    return f'<object id="{number}" type="model" {attributes}>{mesh}</object>'


def robot(path, *visuals, more=""):
    """Write a URDF file of one link that shows these."""
    shapes = "".join(f"<visual>{one}</visual>" for one in visuals)
    path.write_text(f'<robot name="r">{more}<link name="tip">{shapes}</link></robot>')
    return path


def mesh_of_robot(name, more=""):
    return f'<geometry><mesh filename="{name}" {more}/></geometry>'


def stage(*parts, about='metersPerUnit = 0.001\n    upAxis = "Z"', place=""):
    """The text of a USD file."""
    body = "\n".join(parts)
    return f'#usda 1.0\n(\n    {about}\n)\ndef Xform "part"\n{{\n{place}{body}\n}}\n'
