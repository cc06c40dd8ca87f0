"""What is said of a mesh before a photograph is taken."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

import curvireg_torch as cr
from curvireg_torch.inspection.facts import mesh_facts
from curvireg_torch.inspection.look_alikes import (
    LookAlike,
    confused_sides,
    look_alikes,
    print_difference,
)
from curvireg_torch.inspection.page import report_lines, report_page
from curvireg_torch.inspection.photographs import (
    SIZE,
    GeneratedPhotograph,
    PhotographGenerator,
    photographed_mesh,
    trial_camera,
    with_print,
)
from curvireg_torch.inspection.report import Inspection
from curvireg_torch.inspection.surface import look_symmetries
from curvireg_torch.inspection.trial import Expected, Outcome, Trial, run_trial
from curvireg_torch.mesh.mesh import as_mesh
from curvireg_torch.registration import Registrar
from curvireg_torch.synthetic import example_mesh
from tests._support import bank_of, double, eye, refused, slow_after

HALF_TURN = torch.diag(double([-1.0, -1.0, 1.0]))


def plate(size, at):
    box = trimesh.creation.box(size)
    box.apply_translation(at)
    return box


def half_solid_box():
    """A box of 60 x 40 x 30 without a bottom, of which one half is solid: only from below is its
    sides' difference seen."""
    walls = [
        plate((60, 40, 2), (0, 0, 14)),
        plate((60, 2, 30), (0, 19, 0)),
        plate((60, 2, 30), (0, -19, 0)),
        plate((2, 40, 30), (29, 0, 0)),
        plate((2, 40, 30), (-29, 0, 0)),
        plate((30, 40, 30), (15, 0, 0)),
    ]
    return trimesh.util.concatenate(walls)


@pytest.fixture(scope="module")
def inspected(small_bank):
    """A registrar, its report, and the progress of that."""
    registrar = Registrar(small_bank, mesh_is="exact")
    calls = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("curvireg_torch.inspection.look_alikes.LOOKED_AT", 12)
        report = cr.inspect(
            registrar, n=1, compare=False, progress=lambda *progress: calls.append(progress)
        )
    return registrar, report, calls


def test_facts_of_a_closed_body_and_of_its_triangles_apart():
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    box.units = "m"
    apart = trimesh.Trimesh(
        box.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False
    )
    apart.units = "m"
    for mesh in (box, apart):
        facts = mesh_facts(mesh)
        assert facts.is_watertight
        assert (facts.faces, facts.parts, facts.doubled_faces) == (12, 1, 0)
        assert facts.area_of_hull == pytest.approx(1.0)
        assert len(facts.symmetries) == 3
        assert max(symmetry.deviation_percent for symmetry in facts.symmetries) < 0.2
        assert not facts.is_hopeless
        assert any("4 orientations" in text for text in facts.warnings)


def test_open_doubled_and_loose_faces_are_counted():
    box = trimesh.creation.box((1, 2, 3))
    twice = trimesh.Trimesh(
        box.vertices, np.concatenate([box.faces[:-1], box.faces[:3]]), process=False
    )
    other = plate((0.2, 0.2, 0.2), (3, 0, 0))
    facts = mesh_facts(trimesh.util.concatenate([twice, other]))
    assert (facts.parts, facts.doubled_faces) == (2, 3)
    assert not facts.is_watertight
    assert any("3 faces exist twice" in text for text in facts.warnings)


@pytest.mark.parametrize(
    ("size", "unit", "text"),
    [
        (80.0, None, "suggests mm (0.11 m) or cm (1.1 m); give the unit"),
        (
            80.0,
            "m",
            "106 m across: is its unit really m; usual would be mm (0.11 m) or cm (1.1 m)?",
        ),
        (0.3, "mm", "really mm; usual would be m (0.4 m)?"),
        (1000.0, "m", "1,319 m across"),
        (0.3, "m", None),
        (80.0, "dm", None),
    ],
)
def test_unit_is_doubted_by_size(size, unit, text):
    mesh = trimesh.creation.box((size, 0.7 * size, 0.5 * size))
    if unit:
        mesh.units = unit
    warnings = [warning for warning in mesh_facts(mesh).warnings if "unit" in warning]
    assert (text is None) == (not warnings)
    assert text is None or text in warnings[0]


def test_flat_meshes_have_a_flat_hull():
    """One triangle ended in an error of Qhull."""
    triangle = [[0, 0, 0], [100, 0, 0], [0, 80, 0]]
    facts = mesh_facts(trimesh.Trimesh(triangle, [[0, 1, 2]], process=False))
    assert facts.area_of_hull == pytest.approx(0.5)
    square = [[0, 0, 1], [3, 4, 1], [-1, 7, 1], [-4, 3, 1]]
    both = [[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 3, 2]]
    assert mesh_facts(trimesh.Trimesh(square, both, process=False)).area_of_hull == pytest.approx(
        1.0
    )


def test_a_sphere_and_a_wire_are_hopeless():
    sphere = mesh_facts(trimesh.creation.icosphere(2))
    assert sphere.is_hopeless
    assert any("rotation cannot be seen" in text for text in sphere.warnings)
    assert not mesh_facts(trimesh.creation.cylinder(1.0, 2.0)).is_hopeless
    rods = [plate((1, 0.001, 0.001), (0.5, 0, 0)), plate((0.001, 1, 0.001), (0, 0.5, 0))]
    wire = trimesh.util.concatenate([*rods, plate((0.001, 0.001, 1), (0, 0, 0.5))])
    facts = mesh_facts(wire)
    assert facts.is_hopeless
    assert any("wire" in text for text in facts.warnings)


def test_a_room_is_hopeless_and_a_large_object_is_not():
    box = trimesh.creation.box((5.0, 4.0, 2.6))
    room = trimesh.util.concatenate(
        [trimesh.Trimesh(box.vertices, box.faces[:, ::-1]), plate((1.8, 0.9, 0.7), (0, 0, -0.9))]
    )
    room.units = box.units = "m"
    facts = mesh_facts(room)
    assert facts.is_hopeless
    assert "as a room's do" in facts.warnings[-1]
    assert not mesh_facts(box).is_hopeless
    small = room.copy()
    small.units = "cm"
    assert not mesh_facts(small).is_hopeless, "a box that is inside out"


def test_thin_parts_and_flipped_faces_are_told():
    body = trimesh.creation.box((1, 2, 3))
    assert mesh_facts(body).thin == 0.0
    assert mesh_facts(example_mesh()).thin == 0.0, "its parts reach into one another"
    sheet = plate((3.0, 3.0, 0.01), (0, 0, 2))
    facts = mesh_facts(trimesh.util.concatenate([trimesh.creation.box((0.5, 0.5, 0.5)), sheet]))
    assert 0.8 < facts.thin < 1.0
    assert any("thinner than 1 %" in text for text in facts.warnings)
    assert facts.has_consistent_faces
    faces = body.faces.copy()
    faces[0] = faces[0, ::-1]
    flipped = mesh_facts(trimesh.Trimesh(body.vertices, faces, process=False))
    assert not flipped.has_consistent_faces
    assert any("flipped" in text for text in flipped.warnings)


def test_symmetry_deviation_grows_with_the_asymmetry():
    cubes = [
        trimesh.util.concatenate([trimesh.creation.box((1, 2, 3)), plate((s, s, s), (0, 0.9, 1.5))])
        for s in (0.1, 0.2)
    ]
    first, second = (mesh_facts(mesh).symmetries for mesh in cubes)
    assert first
    assert second
    assert max(s.deviation_percent for s in second) > max(s.deviation_percent for s in first)


@pytest.mark.slow
def test_a_half_hollow_box_looks_alike_from_above_and_not_from_below():
    mesh = as_mesh(half_solid_box())
    bank = bank_of(mesh)
    registrar = Registrar(bank, mesh_is="exact")
    assert registrar.symmetries_of(exact=True).shape[0] == 1
    pairs = look_alikes(bank, registrar.describer, None)
    elevation = torch.tensor(
        [float(cr.viewpoint_from_rotation(pair.rotation)[1]) for pair in pairs]
    )
    alike = torch.tensor([pair.is_alike for pair in pairs])
    angle = torch.tensor([pair.angle for pair in pairs])
    assert alike[elevation > 30].all()
    assert alike[elevation < -40].double().mean() == 0.0
    assert (angle[elevation > 30] > 170).all(), "half a turn away"


def test_look_alikes_leave_out_symmetries(monkeypatch):
    monkeypatch.setattr("curvireg_torch.inspection.look_alikes.LOOKED_AT", 12)
    box = as_mesh(trimesh.creation.box((1, 2, 3)))
    views = cr.sample_views(azimuth_step=60, elevations=[-45, 0, 45])
    bank = bank_of(box, views, image_size=64)
    registrar = Registrar(bank, mesh_is="exact")
    symmetries = registrar.symmetries_of(exact=True)
    counted = look_alikes(bank, registrar.describer, None)
    left_out = look_alikes(bank, registrar.describer, symmetries)
    assert np.mean([pair.is_alike for pair in counted]) > 0.8
    assert np.mean([pair.is_alike for pair in left_out]) < 0.3
    assert min(pair.angle for pair in left_out) > 30.0


@pytest.mark.parametrize("clutter", slow_after(1, [False, True]))
def test_photographs_depend_on_seed_and_number_alone(clutter):
    mesh = example_mesh()
    first = PhotographGenerator(mesh, 5, clutter=clutter)
    again = PhotographGenerator(mesh, 5, clutter=clutter)
    first(0)
    one = first(1)
    same = again(1)
    assert torch.equal(one.image, same.image)
    assert torch.equal(one.truth, same.truth)
    other = PhotographGenerator(mesh, 6, clutter=clutter)
    assert not torch.equal(one.truth, other(1).truth)


def test_upright_photographs_are_seen_from_the_side(monkeypatch):
    drawn = torch.zeros(3, *SIZE), torch.zeros(4)
    name = "curvireg_torch.inspection.photographs.synthesize_photograph"
    monkeypatch.setattr(name, lambda *_, **__: drawn)
    generate = PhotographGenerator(example_mesh(), 0, upright=True)
    elevations = [float(cr.viewpoint_from_rotation(generate(k).truth[:3, :3])[1]) for k in range(6)]
    assert min(elevations) > -25.0
    assert max(elevations) < 75.0


def test_clutter_differs_from_photograph_to_photograph(monkeypatch):
    radii = []

    def object_of(radius, _):
        radii.append(radius)
        return trimesh.creation.icosphere(1, radius)

    monkeypatch.setattr("curvireg_torch.inspection.photographs._random_object", object_of)
    generate = PhotographGenerator(trimesh.creation.box((1, 2, 3)), 0, clutter=True)
    generate(0)
    begin = len(radii)
    generate(1)
    assert radii[0] != radii[begin]


@pytest.mark.slow
def test_clutter_is_seen_beside_the_object_and_covers_less_than_half_of_it():
    mesh = trimesh.creation.box((1, 2, 3))
    grey = torch.full((3, *SIZE), 0.5)
    plain = PhotographGenerator(mesh, 3, backgrounds=[grey])
    cluttered = replace(plain, clutter=True)
    changed, covered = [], []
    for index in range(4):
        without, photograph = plain(index), cluttered(index)
        assert torch.equal(photograph.truth, without.truth)
        assert torch.equal(photograph.box, without.box)
        seen = cr.render_depth(mesh, photograph.truth, trial_camera(), SIZE)[0, 0] > 0
        change = (photograph.image.float() - without.image.float()).abs().amax(dim=0) > 20
        changed.append(float(change[~seen].double().mean()))
        covered.append(float(change[seen].double().mean()))
    assert min(changed) > 0.002
    assert max(covered) < 0.5
    assert 0 < sum(fraction > 0.05 for fraction in covered) < 4, "in some photographs"


def test_a_print_varies_over_the_surface_and_leaves_the_shape():
    mesh = trimesh.creation.cylinder(1.0, 3.0)
    mesh.units = "cm"
    printed = with_print(mesh)
    assert printed.has_colours
    assert printed.unit == "cm"
    assert printed.bounds == pytest.approx(mesh.bounds)


def test_ranges_take_their_last_border_in():
    trial = Trial(tuple(outcome(1.0, elevation=e) for e in (-90.0, 0.0, 45.0, 90.0)), {})
    found = trial.by(lambda each: each.elevation, (-90.0, 0.0, 90.0))
    assert {name: expected.n for name, expected in found.items()} == {"-90 to 0": 1, "0 to 90": 3}
    assert list(trial.by(lambda each: each.elevation, (0.0, math.inf))) == ["0 or more"]


@pytest.mark.parametrize("is_coloured", [False, True])
def test_photographs_of_many_faces_show_a_simplified_mesh(monkeypatch, is_coloured):
    fine = trimesh.creation.icosphere(5, 2.0)
    if is_coloured:
        colours = np.where(fine.triangles_center[:, :1] > 0.0, (250, 0, 0, 255), (0, 0, 250, 255))
        fine.visual.face_colors = colours
    fine.units = "cm"
    fine = replace(as_mesh(fine), up="y")
    assert photographed_mesh(fine) is fine
    for name, value in (("MANY_FACES", 9_000), ("COLOURED_FACES", 2_000)):
        monkeypatch.setattr(f"curvireg_torch.inspection.photographs.{name}", value)
    simple = photographed_mesh(fine)
    assert len(simple.faces) <= (2_000 if is_coloured else 8_000)
    assert simple.bounds == pytest.approx(fine.bounds, abs=0.05)
    assert simple.has_colours == is_coloured
    assert (simple.unit, simple.up) == ("cm", "y")
    if is_coloured:
        reds = simple.colours.corners[..., 0] > 125
        sides = simple.vertices[simple.faces][..., 0]
        assert (reds == (sides > 0.0))[np.abs(sides) > 0.1].all()


def test_trial_counts_right_and_reliable_and_stages_are_reported_in_order(inspected):
    _, report, calls = inspected
    assert report.trial.expected.n == 1
    assert not report.trial.compared
    stages = ["mesh", "look-alikes", "photographs"]  # the bank is there
    assert list(dict.fromkeys(stage for stage, _, _ in calls)) == stages
    for stage in stages:
        done = [(done, total) for name, done, total in calls if name == stage]
        assert done == sorted(done)
        assert done[0][0] == 0
        assert done[-1][0] == done[-1][1]


def outcome(error, *, elevation=0.0):
    photograph = GeneratedPhotograph(
        torch.zeros(3, 4, 4, dtype=torch.uint8),
        torch.tensor([0.0, 0, 200, 100]),
        eye(4),
        trial_camera(),
    )
    return Outcome(photograph, None, error, elevation)


def test_expected_shares():
    expected = Expected.of([outcome(error) for error in (1.0, 4.0, 20.0, 170.0)])
    assert (expected.n, expected.right, expected.within_5_deg) == (4, 0.75, 0.5)
    assert (expected.reliable, expected.reliable_and_wrong) == (0.0, 0.0)
    assert expected.median_deg == 4.0


def test_number_below_zero_is_refused():
    with refused("n"):
        cr.inspect(trimesh.creation.box((1, 2, 3)), n=-1)


def test_page_groups_symmetries_by_their_turn():
    can = mesh_facts(trimesh.creation.cylinder(0.3, 1.0, sections=72))
    page = report_page(Inspection(can), title="can")
    assert page.count("<tr><td>180°</td><td>37</td>") == 1
    assert page.count("<tr><td>10°</td><td>2</td>") == 1
    assert "in 1 part, closed" in page


def test_page_escapes_names(inspected):
    _, report, _ = inspected
    assert "<b>" not in report_page(report, title="<b>x").replace("<body>", "")
    assert any(line.startswith("size:") for line in report_lines(report))


@pytest.mark.slow
def test_symmetries_of_colours_are_told_from_those_of_shape():
    bands = trimesh.creation.cylinder(0.3, 1.0, sections=24).subdivide().subdivide()
    height = bands.triangles_center[:, 2]
    bands.visual.face_colors = np.where(
        height[:, None] > 0.2, (200, 30, 30, 255), (30, 30, 200, 255)
    )
    assert len(look_symmetries(bands)) == 36, "no half turn upside down"
    facts = mesh_facts(bands)
    assert facts.is_coloured
    assert any("body of revolution" in text for text in facts.warnings)
    label = bands.copy()
    beside = (bands.triangles_center[:, 0] > 0.2) & (np.abs(height) < 0.1)
    label.visual.face_colors[beside] = (250, 250, 250, 255)
    label.visual.face_colors = np.where(beside[:, None], (250,) * 4, bands.visual.face_colors)
    assert len(look_symmetries(label)) == 1
    assert len(mesh_facts(label).symmetries) == 71


def pair_of(rotation, rival, **more):
    return LookAlike(rotation, rival, 180.0, 0.9, 0.8, **more)


def test_sides_that_are_confused_are_named():
    view = cr.rotation_from_viewpoint(20.0, 30.0, 0.0).double()
    upside_down = torch.diag(double([1.0, -1.0, -1.0]))
    around = pair_of(view, view @ HALF_TURN)
    over = pair_of(view, view @ upside_down)
    quarter = pair_of(view, cr.rotation_from_viewpoint(110.0, 30.0, 0.0).double())
    assert confused_sides([around, around, over], "z") == "front and back"
    assert confused_sides([around, over, over], "z") == "top and bottom"
    assert confused_sides([around], "y") == "top and bottom"
    assert confused_sides([quarter], "z") == "several sides"


def test_one_sentence_says_what_looks_alike_and_what_helps():
    facts = mesh_facts(example_mesh())
    view = cr.rotation_from_viewpoint(20.0, 30.0, 0.0).double()
    turned = view @ HALF_TURN
    alike = pair_of(view, turned, hint="--azimuth")
    other = LookAlike(view, turned, 180.0, 0.2, 0.8)
    brief = Inspection(facts, (alike, alike, alike, *[other] * 7)).in_brief
    remedy = "give a texture or a pose prior (--azimuth)"
    assert brief == f"grey mesh: front and back look alike from 30 % of the views; {remedy}"
    assert Inspection(facts, (other,)).in_brief == "grey mesh: its sides differ in shape"
    told = replace(alike, print_differs=0.5)
    painted = mesh_facts(example_mesh(painted=True))
    brief = Inspection(painted, (told, told, other)).in_brief
    assert brief.endswith("look alike in shape from 67 % of the views; its print tells them apart")
    brief = Inspection(painted, (told, alike)).in_brief
    assert "its print tells 50 % of these apart, a pose prior (--azimuth) the others" in brief


def test_a_print_tells_sides_of_a_box_apart_and_a_plain_one_does_not():
    views = cr.sample_views(azimuth_step=180, elevations=[0])
    box = trimesh.creation.box((1, 2, 3)).subdivide().subdivide()
    middles = box.triangles_center
    red, blue, white = (200, 30, 30, 255), (30, 30, 200, 255), (250, 250, 250, 255)
    coloured = {
        "print": np.where(middles[:, :1] > 0, red, blue),
        "stripe": np.where(np.abs(middles[:, 2:]) > 1, red, white),
    }
    sides = {}
    for name, colours in coloured.items():
        box.visual.face_colors = colours
        mesh = as_mesh(box)
        bank = bank_of(mesh, views)
        describer = Registrar(bank, mesh_is="exact").describer
        view = cr.rotation_from_viewpoint(60.0, 20.0, 0.0).double()
        distance = bank.distances.median().double().cpu()
        sides[name] = print_difference(describer, view, view @ HALF_TURN, distance)
    assert sides["print"] > 0.5
    assert sides["stripe"] < 0.01


@pytest.mark.slow
def test_a_printed_can_is_predicted_better_with_its_texture_than_without():
    printed = with_print(trimesh.creation.cylinder(0.033, 0.12))
    views = cr.sample_views(azimuth_step=30, elevations=[-60, -30, 0, 30, 60])
    generate = PhotographGenerator(printed, 2, upright=True)
    right = {}
    for name, mesh in (("texture", printed), ("grey", replace(printed, colours=None))):
        bank = bank_of(mesh, views)
        registrar = Registrar(bank, mesh_is="exact", symmetries=torch.eye(4)[None].double())
        right[name] = run_trial(registrar, generate, 6, compare=False).expected.right
    assert right["texture"] > right["grey"] + 0.3
